"""The terms of a drawn image on an NVIDIA GPU, by Triton kernels: one pass over it each way.

Sums are taken in a fixed order, so equal input gives equal bits. Input is read as float32.
"""

from typing import Any

import torch
import triton
from torch import Tensor

from lidarpainter_models.kernels.gaussian_raster import SplatImage
from lidarpainter_models.kernels.pixel_losses import PixelFacts, PixelRules, PixelTerms
from lidarpainter_models.kernels.pixel_losses.triton_kernels import (
    MATRIX,
    TERMS,
    judge,
    means,
    unjudge,
)

PIXELS_AT_ONCE = 512
SUMS_AT_ONCE = 1024


def pixel_terms(
    image: SplatImage, sky_rgb: Tensor, facts: PixelFacts, rules: PixelRules, exposure: Tensor
) -> PixelTerms:
    """See `pixel_losses.pixel_terms`."""
    drawn = (image.rgb, image.depth_m, image.alpha, sky_rgb, facts.rgb, facts.lidar_depth_m)
    rgb, depth_m, alpha, sky, target, lidar, exposure = (
        tensor.float().contiguous() for tensor in (*drawn, exposure)
    )
    kind = facts.kind.contiguous()
    shown, sky_mean, depth_mean = _PixelTerms.apply(
        rgb, depth_m, alpha, sky, target, kind, lidar, exposure, rules
    )
    return PixelTerms(shown=shown, sky=sky_mean, depth=depth_mean)


class _PixelTerms(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, *arguments: Any) -> tuple[Tensor, Tensor, Tensor]:  # noqa: ANN401
        *tensors, rules = arguments
        rgb, alpha = tensors[0], tensors[2]
        programs = triton.cdiv(alpha.numel(), PIXELS_AT_ONCE)
        shown, sky_mean, depth_mean = torch.empty_like(rgb), rgb.new_empty(()), rgb.new_empty(())
        sums = rgb.new_empty((programs, TERMS.value), dtype=torch.float64)
        known = rgb.new_empty((), dtype=torch.float64)
        with torch.cuda.device_of(rgb):
            judge[(programs,)](
                *tensors,
                shown,
                sums,
                alpha.numel(),
                float(rules.sky_tolerance),
                float(rules.depth_tolerance),
                BLOCK=PIXELS_AT_ONCE,
            )
            means[(1,)](
                sums, sky_mean, depth_mean, known, programs, alpha.numel(), BLOCK=SUMS_AT_ONCE
            )
        ctx.save_for_backward(*tensors, known)
        ctx.rules = rules
        return shown, sky_mean, depth_mean

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *upstream: Tensor) -> tuple[Tensor | None, ...]:  # noqa: ANN401
        rgb, depth_m, alpha, sky = ctx.saved_tensors[:4]
        found = [torch.empty_like(tensor) for tensor in (rgb, depth_m, alpha, sky)]
        programs = triton.cdiv(alpha.numel(), PIXELS_AT_ONCE)
        shares = rgb.new_empty((programs, MATRIX.value), dtype=torch.float64)
        with torch.cuda.device_of(rgb):
            unjudge[(programs,)](
                *ctx.saved_tensors,
                *(gradient.contiguous() for gradient in upstream),
                *found,
                shares,
                alpha.numel(),
                float(ctx.rules.sky_tolerance),
                float(ctx.rules.depth_tolerance),
                float(ctx.rules.min_transmittance),
                BLOCK=PIXELS_AT_ONCE,
            )
        to_exposure = shares.sum(dim=0).float().view(3, 4) if ctx.needs_input_grad[7] else None
        return *found, None, None, None, to_exposure, None
