"""The rasteriser on the CPU: numba kernels behind one autograd function for any number of views.

Images and gradients are bitwise the same for any number of threads (numba's setting,
`numba.set_num_threads`). Input is read as float32 (transforms as float64) and must lie on the CPU.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.kernels.gaussian_raster.binning import TileLists, list_tiles
from lidarpainter_models.kernels.gaussian_raster.blending import Images, blend
from lidarpainter_models.kernels.gaussian_raster.blending_gradients import entry_sums
from lidarpainter_models.kernels.gaussian_raster.blending_limits import TANGENT_MARGIN
from lidarpainter_models.kernels.gaussian_raster.projection import (
    CHUNKS,
    IS_VISIBLE,
    SIGMA,
    Gaussians,
    View,
    project,
)
from lidarpainter_models.kernels.gaussian_raster.projection_gradients import Gradients, unproject
from lidarpainter_models.kernels.gaussian_raster.splats import DrawnImages, Splats
from lidarpainter_models.kernels.side_by_side import kernels_to_oneself

IMAGES = 6
"""Tensors that a view gives: four images, visible and radius."""


def draw_views(
    splats: Splats,
    features: Float[Tensor, "gaussians features"],
    camera_from_body: Float[Tensor, "views bodies 4 4"],
    cameras: Sequence[Camera],
    screen_gradients_out: Float[Tensor, "views gaussians"] | None,
) -> list[DrawnImages]:
    """Images as `SplatImage` lists them: rgb, depth, alpha, features, visible, radius."""
    drawn = _DrawViews.apply(
        splats.means,
        splats.rotation_wxyz,
        splats.scale_m,
        splats.opacity,
        splats.sh,
        features,
        camera_from_body,
        splats.body_index,
        cameras,
        screen_gradients_out,
    )
    return [drawn[first : first + IMAGES] for first in range(0, len(drawn), IMAGES)]


def _array(tensor: Tensor, dtype: torch.dtype = torch.float32) -> np.ndarray:
    return tensor.detach().to(dtype).contiguous().numpy()


def _gaussians(tensors: tuple[Tensor, ...]) -> Gaussians:
    means, rotation, scale, opacity, sh, features, transforms, body_index = tensors
    return Gaussians(
        means=_array(means),
        rotation_wxyz=_array(rotation),
        scale_m=_array(scale),
        opacity=_array(opacity),
        sh=_array(sh),
        body_index=_array(body_index, torch.int32),
        features=_array(features),
        camera_from_body=_array(transforms, torch.float64),
    )


def _compiled_view(view: Camera) -> View:
    margin_x = TANGENT_MARGIN * 0.5 * view.width_px / view.fx_px
    margin_y = TANGENT_MARGIN * 0.5 * view.height_px / view.fy_px
    return View(
        fx=view.fx_px,
        fy=view.fy_px,
        cx=view.cx_px,
        cy=view.cy_px,
        width=view.width_px,
        height=view.height_px,
        lowest_x=-view.cx_px / view.fx_px - margin_x,
        highest_x=(view.width_px - view.cx_px) / view.fx_px + margin_x,
        lowest_y=-view.cy_px / view.fy_px - margin_y,
        highest_y=(view.height_px - view.cy_px) / view.fy_px + margin_y,
    )


def _images(tensors: tuple[Tensor, ...], light: np.ndarray) -> Images:
    rgb, depth, alpha, features = map(_array, tensors)
    return Images(rgb, depth, alpha, features, light)


def _of_view(gaussians: Gaussians, place: int) -> Gaussians:
    """The Gaussians with the transforms of one view."""
    return gaussians._replace(camera_from_body=gaussians.camera_from_body[place])


@dataclass(frozen=True, kw_only=True, eq=False)
class _DrawnView:
    """What a backward pass needs to know of one view."""

    view: View
    records: np.ndarray
    lists: TileLists
    light: np.ndarray


class _DrawViews(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, *arguments: Any) -> tuple[Tensor, ...]:  # noqa: ANN401
        *tensors, cameras, screen_gradients_out = arguments
        gaussians = _gaussians(tuple(tensors))
        drawn: list[Tensor] = []
        ctx.views = []
        with kernels_to_oneself():
            for place, view in enumerate(cameras):
                compiled = _compiled_view(view)
                records = project(_of_view(gaussians, place), compiled)
                lists = list_tiles(records, view.width_px, view.height_px)
                images = blend(records, gaussians.features, lists, view.width_px, view.height_px)
                ctx.views.append(
                    _DrawnView(view=compiled, records=records, lists=lists, light=images.light)
                )
                drawn += [torch.from_numpy(image) for image in images[:4]]
                drawn.append(torch.from_numpy(records[:, IS_VISIBLE] > 0.0))
                drawn.append(torch.from_numpy(3.0 * records[:, SIGMA]))
        floats = [drawn[k] for k in range(len(drawn)) if k % IMAGES < 4]
        ctx.save_for_backward(*tensors, *floats)
        ctx.mark_non_differentiable(*(drawn[k] for k in range(len(drawn)) if k % IMAGES >= 4))
        ctx.screen_gradients_out = screen_gradients_out
        return tuple(drawn)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *output_gradients: Tensor) -> tuple[Tensor | None, ...]:  # noqa: ANN401
        count = len(ctx.saved_tensors) - 4 * len(ctx.views)
        tensors, images = ctx.saved_tensors[:count], ctx.saved_tensors[count:]
        gaussians = _gaussians(tensors)
        found = _room_for_gradients(gaussians)
        with kernels_to_oneself():
            for place, drawn in enumerate(ctx.views):
                given = output_gradients[IMAGES * place : IMAGES * place + 4]
                slots = entry_sums(
                    drawn.records,
                    gaussians.features,
                    drawn.lists,
                    _images(images[4 * place : 4 * place + 4], drawn.light),
                    _images(given, drawn.light),
                )
                own = _gradients_of_view(found, place)
                of_view = _of_view(gaussians, place)
                unproject(of_view, drawn.view, drawn.records, drawn.lists, slots, own, place > 0)
        if ctx.screen_gradients_out is not None:
            ctx.screen_gradients_out.copy_(torch.from_numpy(found.absolute))
        return (*_tensor_gradients(found, tensors), None, None, None)


def _room_for_gradients(gaussians: Gaussians) -> Gradients:
    """Arrays for `unproject` to fill; the last two have a row per view."""
    count, (views, bodies) = len(gaussians.means), gaussians.camera_from_body.shape[:2]
    return Gradients(
        means=np.empty((count, 3), np.float32),
        rotation_wxyz=np.empty((count, 4), np.float32),
        scale_m=np.empty((count, 3), np.float32),
        opacity=np.empty(count, np.float32),
        sh=np.empty(gaussians.sh.shape, np.float32),
        features=np.empty(gaussians.features.shape, np.float32),
        absolute=np.empty((views, count), np.float32),
        camera_from_body=np.zeros((views, CHUNKS, bodies, 3, 4)),
    )


def _gradients_of_view(found: Gradients, place: int) -> Gradients:
    """The sums that views share, and the arrays of one view."""
    return found._replace(
        absolute=found.absolute[place],
        camera_from_body=found.camera_from_body[place],
    )


def _tensor_gradients(found: Gradients, tensors: tuple[Tensor, ...]) -> list[Tensor]:
    """Gradients in the order and kinds of the float tensors that were given."""
    views, _, bodies = found.camera_from_body.shape[:3]
    to_transforms = np.zeros((views, bodies, 4, 4))
    for run in range(CHUNKS):
        to_transforms[:, :, :3] += found.camera_from_body[:, run]
    arrays = (
        found.means,
        found.rotation_wxyz,
        found.scale_m,
        found.opacity,
        found.sh,
        found.features,
        to_transforms,
    )
    return [
        torch.from_numpy(array).to(tensor.dtype)
        for array, tensor in zip(arrays, tensors, strict=False)
    ]
