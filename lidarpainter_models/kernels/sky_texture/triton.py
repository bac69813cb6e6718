"""Sky texture look-ups on an NVIDIA GPU: one launch each, and four for the sums on texels.

A dense Adam over the texture is cheap there. Nothing depends on the order in which a GPU works, so
equal input gives equal bits.
"""

import torch
import triton
from torch import Tensor

from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.kernels.gpu_packages import dense_in_place
from lidarpainter_models.kernels.sky_texture import SkyLayout, SkyRays, TexelMoments
from lidarpainter_models.kernels.sky_texture.triton_kernels import (
    BLOCK,
    TURN,
    VALUES,
    add_terms,
    find_peaks,
    finish_sums,
    locate_pixels,
    sample_pixels,
    step_adam,
)

WARPS = 8
"""Warps of a program: four lanes a thread."""
SUM_BITS = 62
"""Bits of a texel's sum without its sign; one is left over for terms rounded otherwise."""


def locate(camera: Camera, layout: SkyLayout, wanted: Tensor) -> Tensor:
    """See `sky_texture.sky_rays`."""
    places = torch.empty((*wanted.shape, 2), device=wanted.device)
    rotation = camera.world_from_camera[:3, :3].detach().flatten().tolist()
    with torch.cuda.device_of(places):
        locate_pixels[_programs(wanted.numel())](
            places,
            camera.width_px,
            wanted.numel(),
            float(camera.fx_px),
            float(camera.fy_px),
            float(camera.cx_px),
            float(camera.cy_px),
            *rotation,
            float(layout.azimuth_left_rad),
            float(layout.elevation_top_rad),
            float(layout.texel_rad),
            (TURN.value - layout.columns * layout.texel_rad) / 2,
            num_warps=WARPS,
        )
    return places


def sample(texture: Tensor, rays: SkyRays, layout: SkyLayout) -> Tensor:
    """See `sky_texture.sample_sky`."""
    count = rays.wanted.numel()
    rgb = texture.new_empty((*rays.wanted.shape, 3))
    if count == 0:
        return rgb
    with torch.cuda.device_of(texture):
        sample_pixels[_programs(count)](
            texture.contiguous(),
            rays.places.contiguous(),
            rays.wanted.contiguous(),
            rgb,
            layout.columns,
            layout.rows,
            count,
            WRAPS=layout.wraps,
            num_warps=WARPS,
        )
    return rgb


def scatter(
    gradient: Tensor, weight: Tensor, rays: SkyRays, layout: SkyLayout
) -> tuple[Tensor, Tensor]:
    """See `sky_texture.scatter_gradient`.

    Terms are rounded to integers at most 2^-24 as large as the largest on their texel, images of
    less than 2^33 pixels provided: finer than a sum of float32. A sum that is not finite is NaN.
    """
    count, texels = weight.numel(), layout.rows * layout.columns
    sums, peaks = _accumulators(texels, gradient.device)
    texel_gradient = gradient.new_empty((layout.rows, layout.columns, 3))
    texel_weight = weight.new_empty((layout.rows, layout.columns))
    digits = SUM_BITS - (4 * count).bit_length()
    pixels = (gradient.contiguous(), weight.contiguous(), rays.places.contiguous(), peaks)
    size = (layout.columns, layout.rows, count)
    with torch.cuda.device_of(gradient):
        if count:
            options = {"WRAPS": layout.wraps, "num_warps": WARPS}
            find_peaks[_programs(count)](*pixels, *size, **options)
            add_terms[_programs(count)](*pixels, sums, *size, digits, **options)
        found = (texel_gradient, texel_weight)
        finish_sums[_programs(texels)](peaks, sums, *found, texels, digits, num_warps=WARPS)
    return texel_gradient, texel_weight


def adam(
    texture: Tensor, moments: TexelMoments, gradient: Tensor, weight: Tensor, learning_rate: float
) -> None:
    """See `sky_texture.step_texels`."""
    kept = (texture, moments.first, moments.second, moments.visits)
    with torch.cuda.device_of(texture), dense_in_place(kept) as dense:
        step_adam[_programs(weight.numel())](
            *dense,
            gradient.contiguous(),
            weight.contiguous(),
            float(learning_rate),
            weight.numel(),
            num_warps=WARPS,
        )


def _programs(lanes: int) -> tuple[int]:
    return (triton.cdiv(lanes, BLOCK.value),)


def _accumulators(texels: int, device: torch.device) -> tuple[Tensor, Tensor]:
    """Zeros for the sums of each texel (int64) and for what is largest in them (int32)."""
    values = texels * VALUES.value
    zeros = torch.zeros(values + triton.cdiv(values, 2), dtype=torch.int64, device=device)
    return zeros[:values], zeros[values:].view(torch.int32)
