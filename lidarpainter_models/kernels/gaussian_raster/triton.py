"""The rasteriser on an NVIDIA GPU by Triton kernels of this project: pip alone, no compiler.

Projection, tile lists and blending are kernels below `triton_kernels/`; torch sorts the lists. The
device is waited for once: the number of pairs of Gaussians and tiles says how much room the lists
need. Input is read as float32 (transforms as float64). Sums are taken in a fixed order, so equal
input gives equal bits.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
import triton
from jaxtyping import Float
from torch import Tensor

from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.kernels.gaussian_raster import DrawnImages, Splats
from lidarpainter_models.kernels.gaussian_raster.blending_limits import TILE_PX, linear_tangents
from lidarpainter_models.kernels.gaussian_raster.triton_kernels.blending import blend
from lidarpainter_models.kernels.gaussian_raster.triton_kernels.blending_gradients import (
    SLOT,
    entry_sums,
    gaussian_sums,
)
from lidarpainter_models.kernels.gaussian_raster.triton_kernels.lists import write_keys
from lidarpainter_models.kernels.gaussian_raster.triton_kernels.projection import project
from lidarpainter_models.kernels.gaussian_raster.triton_kernels.projection_gradients import (
    unproject,
)
from lidarpainter_models.kernels.gaussian_raster.triton_kernels.records import FLOATS, IS_VISIBLE

GAUSSIANS_AT_ONCE = 64
PAIRS_AT_ONCE = 256
ENTRIES_AT_ONCE = 32


def draw_view(
    splats: Splats,
    features: Float[Tensor, "gaussians features"],
    camera_from_body: Float[Tensor, "bodies 4 4"],
    camera: Camera,
    screen_gradient_out: Float[Tensor, " gaussians"] | None,
) -> DrawnImages:
    """Images as `SplatImage` lists them."""
    with torch.cuda.device_of(splats.means):
        return _DrawView.apply(
            *(tensor.float().contiguous() for tensor in (*splats.learned, features)),
            camera_from_body.double().contiguous(),
            splats.body_index.int().contiguous(),
            camera,
            screen_gradient_out,
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class _Projected:
    """Gaussians on one view's screen, and where each one's pairs with tiles begin."""

    view: Camera
    lens: Float[Tensor, "8"]
    records: Float[Tensor, "gaussians floats"]
    first_pair: Tensor

    @property
    def columns(self) -> int:
        return triton.cdiv(self.view.width_px, TILE_PX)

    @property
    def rows(self) -> int:
        return triton.cdiv(self.view.height_px, TILE_PX)


@dataclass(frozen=True, kw_only=True, eq=False)
class _Lists:
    """The Gaussians of each tile, nearest first, and the entry that each pair became."""

    tile_first: Tensor
    gaussian: Tensor
    entry_of_pair: Tensor


class _DrawView(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, *arguments: Any) -> tuple[Tensor, ...]:  # noqa: ANN401
        *tensors, camera, ctx.screen_gradient_out = arguments
        screen = _project(tensors, camera)
        lists = _list_tiles(screen, int(screen.first_pair[-1]))
        rgb, depth, light, feature_image = _blend(screen, lists, tensors[5])
        visible = screen.records[:, IS_VISIBLE.value] > 0.0
        ctx.kept = screen, lists, light
        ctx.save_for_backward(*tensors, rgb, depth, feature_image)
        ctx.mark_non_differentiable(visible)
        return rgb, depth, 1.0 - light, feature_image, visible

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *output_gradients: Tensor) -> tuple[Tensor | None, ...]:  # noqa: ANN401
        *tensors, rgb, depth, feature_image = ctx.saved_tensors
        screen, lists, light = ctx.kept
        found = [torch.zeros_like(tensor) for tensor in tensors[:7]]
        absolute = tensors[0].new_zeros(len(tensors[0]))
        with torch.cuda.device_of(absolute):
            images = (rgb, depth, light, feature_image)
            sums = _sums(screen, lists, tensors[5], images, output_gradients[:4], found[5])
            _unproject(screen, tensors, sums, found, absolute)
        if ctx.screen_gradient_out is not None:
            ctx.screen_gradient_out.copy_(absolute)
        return (*found, None, None, None)


def _project(tensors: Sequence[Tensor], view: Camera) -> _Projected:
    means, rotation_wxyz, scale_m, opacity, sh, _, camera_from_body, body_index = tensors
    count = len(means)
    numbers = (view.fx_px, view.fy_px, view.cx_px, view.cy_px, *linear_tangents(view))
    lens = torch.tensor(numbers, dtype=torch.float64).to(means.device, non_blocking=True)
    records = means.new_empty((count, FLOATS.value))
    first_pair = torch.zeros(count + 1, dtype=torch.int64, device=means.device)
    if count:
        tiles = torch.empty(count, dtype=torch.int32, device=means.device)
        project[(triton.cdiv(count, GAUSSIANS_AT_ONCE),)](
            means,
            rotation_wxyz,
            scale_m,
            opacity,
            sh,
            body_index,
            camera_from_body,
            lens,
            records,
            tiles,
            count,
            view.width_px,
            view.height_px,
            COEFFICIENTS=sh.shape[1],
            BLOCK=GAUSSIANS_AT_ONCE,
            num_warps=2,
        )
        torch.cumsum(tiles, dim=0, out=first_pair[1:])
    return _Projected(view=view, lens=lens, records=records, first_pair=first_pair)


def _list_tiles(screen: _Projected, pairs: int) -> _Lists:
    """Sort pairs by tile and depth; those that miss their tile lie behind the last tile's."""
    device, tiles = screen.records.device, screen.columns * screen.rows
    keys = torch.empty(pairs, dtype=torch.int64, device=device)
    gaussians = torch.arange(len(screen.records), dtype=torch.int32, device=device)
    owner = torch.repeat_interleave(gaussians, screen.first_pair.diff(), output_size=pairs)
    if pairs:
        write_keys[(triton.cdiv(pairs, PAIRS_AT_ONCE),)](
            screen.records,
            owner,
            screen.first_pair,
            keys,
            pairs,
            screen.columns,
            screen.rows,
            BLOCK=PAIRS_AT_ONCE,
        )
    # stable: equal depths keep the order of their index
    keys, order = torch.sort(keys, stable=True)
    starts = torch.arange(tiles + 1, dtype=torch.int64, device=device) << 32
    entry_of_pair = torch.empty(pairs, dtype=torch.int32, device=device)
    entry_of_pair[order] = torch.arange(pairs, dtype=torch.int32, device=device)
    return _Lists(
        tile_first=torch.searchsorted(keys, starts, out_int32=True),
        gaussian=owner[order],
        entry_of_pair=entry_of_pair,
    )


def _blend(
    screen: _Projected, lists: _Lists, features: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Colour, depth, light that passes all, and features."""
    size, channels = (screen.view.height_px, screen.view.width_px), features.shape[1]
    rgb, depth = features.new_empty((*size, 3)), features.new_empty(size)
    light, feature_image = features.new_empty(size), features.new_empty((*size, channels))
    blend[(screen.columns * screen.rows,)](
        screen.records,
        features,
        lists.tile_first,
        lists.gaussian,
        rgb,
        depth,
        light,
        feature_image,
        screen.view.width_px,
        screen.view.height_px,
        screen.columns,
        CHANNELS=channels,
        ROOM=triton.next_power_of_2(max(channels, 1)),
        num_warps=4,
    )
    return rgb, depth, light, feature_image


def _sums(
    screen: _Projected,
    lists: _Lists,
    features: Tensor,
    images: Sequence[Tensor],
    given: Sequence[Tensor],
    to_features: Tensor,
) -> Tensor:
    """Sums over the pixels of each Gaussian; the gradient of the features is added to theirs."""
    entries, channels = len(lists.gaussian), features.shape[1]
    slots = features.new_zeros((entries, SLOT.value))
    feature_slots = features.new_zeros((entries, channels))
    sums = torch.empty((len(features), SLOT.value), dtype=torch.float64, device=features.device)
    room = triton.next_power_of_2(max(channels, 1))
    entry_sums[(screen.columns * screen.rows,)](
        screen.records,
        features,
        lists.tile_first,
        lists.gaussian,
        *images,
        *(gradient.contiguous() for gradient in given),
        slots,
        feature_slots,
        screen.view.width_px,
        screen.view.height_px,
        screen.columns,
        CHANNELS=channels,
        ROOM=room,
        num_warps=1,
    )
    if len(features):
        gaussian_sums[(len(features),)](
            screen.first_pair,
            lists.entry_of_pair,
            slots,
            feature_slots,
            sums,
            to_features,
            CHANNELS=channels,
            ROOM=room,
            ENTRIES=ENTRIES_AT_ONCE,
            num_warps=1,
        )
    return sums


def _unproject(
    screen: _Projected,
    tensors: Sequence[Tensor],
    sums: Tensor,
    found: Sequence[Tensor],
    absolute: Tensor,
) -> None:
    """Add the gradients to `found`, which holds zeros as `absolute` does."""
    means, rotation_wxyz, scale_m, opacity, sh, _, camera_from_body, body_index = tensors
    to_means, to_rotation, to_scale, to_opacity, to_sh, _, to_transforms = found
    if len(means) == 0:
        return
    unproject[(triton.cdiv(len(means), GAUSSIANS_AT_ONCE),)](
        means,
        rotation_wxyz,
        scale_m,
        opacity,
        sh,
        body_index,
        camera_from_body,
        screen.lens,
        screen.records,
        sums,
        to_means,
        to_rotation,
        to_scale,
        to_opacity,
        to_sh,
        to_transforms,
        absolute,
        len(means),
        COEFFICIENTS=sh.shape[1],
        BLOCK=GAUSSIANS_AT_ONCE,
        num_warps=2,
    )
