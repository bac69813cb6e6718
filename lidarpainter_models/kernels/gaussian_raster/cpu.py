"""The rasteriser on the CPU: numba kernels behind one autograd function.

Pictures and gradients are bitwise the same for any number of threads (numba's setting,
`numba.set_num_threads`). Input is read as float32 (transforms as float64) and must lie on the CPU.
"""

import threading
from typing import Any

import numpy as np
import torch
from torch import Tensor

from lidarpainter_models.errors import BackendError
from lidarpainter_models.kernels.gaussian_raster.binning import list_tiles
from lidarpainter_models.kernels.gaussian_raster.blending import Pictures, blend
from lidarpainter_models.kernels.gaussian_raster.blending_gradients import entry_sums
from lidarpainter_models.kernels.gaussian_raster.blending_limits import TANGENT_MARGIN
from lidarpainter_models.kernels.gaussian_raster.projection import (
    IS_VISIBLE,
    SIGMA,
    Gaussians,
    View,
    project,
)
from lidarpainter_models.kernels.gaussian_raster.projection_gradients import Gradients, unproject
from lidarpainter_models.kernels.gaussian_raster.splat_inputs import (
    DrawnPictures,
    SplatInputs,
    SplatView,
)

ONE_AT_A_TIME = threading.Lock()
"""numba's thread pools may not be entered by two Python threads at once."""


def draw_gaussians(
    inputs: SplatInputs, view: SplatView, screen_gradient_out: Tensor | None
) -> DrawnPictures:
    """Picture as `SplatImage` lists it: rgb, depth, alpha, features, visible, radius.

    Raises:
        BackendError: the tensors are not on the CPU.
    """
    if inputs.means.device.type != "cpu":
        raise BackendError(f"the cpu backend needs tensors on the CPU, got {inputs.means.device}")
    return _DrawGaussians.apply(
        inputs.means,
        inputs.rotation_wxyz,
        inputs.scale_m,
        inputs.opacity,
        inputs.sh,
        inputs.features,
        inputs.screen_offset,
        inputs.camera_from_body,
        inputs.body_index,
        view,
        screen_gradient_out,
    )


def _array(tensor: Tensor, dtype: torch.dtype = torch.float32) -> np.ndarray:
    return tensor.detach().to(dtype).contiguous().numpy()


def _gaussians(tensors: tuple[Tensor, ...]) -> Gaussians:
    means, rotation, scale, opacity, sh, features, offset, transforms, body_index = tensors
    return Gaussians(
        means=_array(means),
        rotation_wxyz=_array(rotation),
        scale_m=_array(scale),
        opacity=_array(opacity),
        sh=_array(sh),
        body_index=_array(body_index, torch.int32),
        features=_array(features),
        screen_offset=_array(offset),
        camera_from_body=_array(transforms, torch.float64),
    )


def _compiled_view(view: SplatView) -> View:
    margin_x = TANGENT_MARGIN * 0.5 * view.width_px / view.fx_px
    margin_y = TANGENT_MARGIN * 0.5 * view.height_px / view.fy_px
    return View(
        fx=view.fx_px,
        fy=view.fy_px,
        cx=view.cx_px,
        cy=view.cy_px,
        width=view.width_px,
        height=view.height_px,
        near=view.near_m,
        blur=view.blur_px2,
        antialias=view.antialias,
        lowest_x=-view.cx_px / view.fx_px - margin_x,
        highest_x=(view.width_px - view.cx_px) / view.fx_px + margin_x,
        lowest_y=-view.cy_px / view.fy_px - margin_y,
        highest_y=(view.height_px - view.cy_px) / view.fy_px + margin_y,
    )


def _pictures(tensors: tuple[Tensor, ...], light: np.ndarray) -> Pictures:
    rgb, depth, alpha, features = map(_array, tensors)
    return Pictures(rgb, depth, alpha, features, light)


class _DrawGaussians(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, *arguments: Any) -> DrawnPictures:  # noqa: ANN401
        *tensors, view, screen_gradient_out = arguments
        gaussians, compiled_view = _gaussians(tuple(tensors)), _compiled_view(view)
        with ONE_AT_A_TIME:
            records = project(gaussians, compiled_view)
            lists = list_tiles(records, view.width_px, view.height_px)
            drawn = blend(records, gaussians.features, lists, view.width_px, view.height_px)
        rgb, depth_m, alpha, features = (torch.from_numpy(picture) for picture in drawn[:4])
        visible = torch.from_numpy(records[:, IS_VISIBLE] > 0.0)
        radius_px = torch.from_numpy(3.0 * records[:, SIGMA])
        ctx.save_for_backward(*tensors, rgb, depth_m, alpha, features)
        ctx.mark_non_differentiable(visible, radius_px)
        ctx.view, ctx.records, ctx.lists, ctx.light = compiled_view, records, lists, drawn.light
        ctx.screen_gradient_out = screen_gradient_out
        return rgb, depth_m, alpha, features, visible, radius_px

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *output_gradients: Tensor) -> tuple[Tensor | None, ...]:  # noqa: ANN401
        tensors, pictures = ctx.saved_tensors[:-4], ctx.saved_tensors[-4:]
        gaussians = _gaussians(tensors)
        drawn = _pictures(pictures, ctx.light)
        gradients = _pictures(output_gradients[:4], ctx.light)
        with ONE_AT_A_TIME:
            slots = entry_sums(ctx.records, gaussians.features, ctx.lists, drawn, gradients)
            found = unproject(gaussians, ctx.view, ctx.records, ctx.lists, slots)
        if ctx.screen_gradient_out is not None:
            ctx.screen_gradient_out.copy_(torch.from_numpy(found.absolute))
        return (*_tensor_gradients(found, tensors), None, None, None)


def _tensor_gradients(found: Gradients, tensors: tuple[Tensor, ...]) -> list[Tensor]:
    """Gradients in the order and kinds of the float tensors that were given."""
    to_transforms = np.zeros((found.camera_from_body.shape[1], 4, 4))
    for run in found.camera_from_body:
        to_transforms[:, :3] += run
    arrays = (
        found.means,
        found.rotation_wxyz,
        found.scale_m,
        found.opacity,
        found.sh,
        found.features,
        found.screen_offset,
        to_transforms,
    )
    return [
        torch.from_numpy(array).to(tensor.dtype)
        for array, tensor in zip(arrays, tensors, strict=False)
    ]
