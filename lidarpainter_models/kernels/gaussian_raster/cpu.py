"""The rasteriser on the CPU: numba kernels behind one autograd function.

Images and gradients are bitwise the same for any number of threads (numba's setting,
`numba.set_num_threads`). Input is read as float32 (transforms as float64) and must lie on the CPU.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.kernels.gaussian_raster import DrawnImages, Splats
from lidarpainter_models.kernels.gaussian_raster.binning import list_tiles
from lidarpainter_models.kernels.gaussian_raster.blending import Images, blend
from lidarpainter_models.kernels.gaussian_raster.blending_gradients import entry_sums
from lidarpainter_models.kernels.gaussian_raster.blending_limits import linear_tangents
from lidarpainter_models.kernels.gaussian_raster.projection import (
    CHUNKS,
    IS_VISIBLE,
    Gaussians,
    View,
    project,
)
from lidarpainter_models.kernels.gaussian_raster.projection_gradients import Gradients, unproject
from lidarpainter_models.kernels.side_by_side import kernels_to_oneself


def draw_view(
    splats: Splats,
    features: Float[Tensor, "gaussians features"],
    camera_from_body: Float[Tensor, "bodies 4 4"],
    camera: Camera,
    screen_gradient_out: Float[Tensor, " gaussians"] | None,
) -> DrawnImages:
    """Images as `SplatImage` lists them."""
    return _DrawView.apply(
        *splats.learned, features, camera_from_body, splats.body_index, camera, screen_gradient_out
    )


def _array(tensor: Tensor, dtype: torch.dtype = torch.float32) -> np.ndarray:
    return tensor.detach().to(dtype).contiguous().numpy()


def _gaussians(tensors: Sequence[Tensor]) -> Gaussians:
    *floats, transforms, body_index = tensors
    poses, bodies = _array(transforms, torch.float64), _array(body_index, torch.int32)
    return Gaussians._make([*map(_array, floats), poses, bodies])


def _compiled_view(view: Camera) -> View:
    lens = (view.fx_px, view.fy_px, view.cx_px, view.cy_px)
    return View(*lens, view.width_px, view.height_px, *linear_tangents(view))


def _images(tensors: tuple[Tensor, ...], light: np.ndarray) -> Images:
    rgb, depth, alpha, features = map(_array, tensors)
    return Images(rgb, depth, alpha, features, light)


class _DrawView(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, *arguments: Any) -> tuple[Tensor, ...]:  # noqa: ANN401
        *tensors, camera, ctx.screen_gradient_out = arguments
        gaussians, view = _gaussians(tensors), _compiled_view(camera)
        with kernels_to_oneself():
            records = project(gaussians, view)
            lists = list_tiles(records, view.width, view.height)
            images = blend(records, gaussians.features, lists, view.width, view.height)
        ctx.kept = view, records, lists, images.light
        drawn = [torch.from_numpy(image) for image in images[:4]]
        visible = torch.from_numpy(records[:, IS_VISIBLE] > 0.0)
        ctx.save_for_backward(*tensors, *drawn)
        ctx.mark_non_differentiable(visible)
        return *drawn, visible

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *output_gradients: Tensor) -> tuple[Tensor | None, ...]:  # noqa: ANN401
        tensors, images = ctx.saved_tensors[:-4], ctx.saved_tensors[-4:]
        view, records, lists, light = ctx.kept
        gaussians = _gaussians(tensors)
        found = _room_for_gradients(gaussians)
        with kernels_to_oneself():
            drawn, given = _images(images, light), _images(output_gradients[:4], light)
            slots = entry_sums(records, gaussians.features, lists, drawn, given)
            unproject(gaussians, view, records, lists, slots, found)
        if ctx.screen_gradient_out is not None:
            ctx.screen_gradient_out.copy_(torch.from_numpy(found.absolute))
        return (*_tensor_gradients(found, tensors), None, None, None)


def _room_for_gradients(gaussians: Gaussians) -> Gradients:
    """Arrays for `unproject` to fill."""
    count, bodies = len(gaussians.means), len(gaussians.camera_from_body)
    return Gradients(
        means=np.empty((count, 3), np.float32),
        rotation_wxyz=np.empty((count, 4), np.float32),
        scale_m=np.empty((count, 3), np.float32),
        opacity=np.empty(count, np.float32),
        sh=np.empty(gaussians.sh.shape, np.float32),
        features=np.empty(gaussians.features.shape, np.float32),
        camera_from_body=np.zeros((CHUNKS, bodies, 3, 4)),
        absolute=np.empty(count, np.float32),
    )


def _tensor_gradients(found: Gradients, tensors: tuple[Tensor, ...]) -> list[Tensor]:
    """Gradients in the order and kinds of the float tensors that were given."""
    to_transforms = np.zeros((found.camera_from_body.shape[1], 4, 4))
    for of_run in found.camera_from_body:
        to_transforms[:, :3] += of_run
    return [
        torch.from_numpy(array).to(tensor.dtype)
        for array, tensor in zip((*found[:6], to_transforms), tensors, strict=False)
    ]
