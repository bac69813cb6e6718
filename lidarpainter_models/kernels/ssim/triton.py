"""Structural similarity and its gradient on an NVIDIA GPU: one Triton kernel each way.

The way there leaves the derivatives by the windowed means in memory, the way back blurs them. Sums
are taken in a fixed order, so equal input gives equal bits. Input is read as float32.
"""

from typing import Any

import torch
import triton
from torch import Tensor

from lidarpainter_models.kernels.ssim.triton_kernels import compare, spread

COLUMNS_AT_ONCE, ROWS_AT_ONCE = 128, 16
"""Size of the strip of an image, channels interleaved, that a program blurs at once; it reads ten
rows more than it writes."""


def ssim_map(first_rgb: Tensor, second_rgb: Tensor) -> Tensor:
    """SSIM around every pixel; differentiable in the first image."""
    return _SsimMap.apply(*_as_read(first_rgb, second_rgb))


def l1_ssim_loss(
    rendered: Tensor, target: Tensor, pixel_weight: Tensor | None, ssim_weight: float
) -> Tensor:
    """The loss defined at `lidarpainter_models.kernels.ssim.l1_ssim_loss`."""
    images, weight = _as_read(rendered, target), None
    if pixel_weight is not None:
        (weight,) = _as_read(pixel_weight)
    return _L1SsimLoss.apply(*images, weight, ssim_weight)


class _SsimMap(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, first: Tensor, second: Tensor) -> Tensor:  # noqa: ANN401
        similarity = torch.empty_like(first)
        partials = _room_for_partials(first, is_needed=ctx.needs_input_grad[0])
        _compare(first, second, None, similarity, None, partials, 0.0)
        ctx.save_for_backward(first, second, partials)
        return similarity

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *upstream: Tensor) -> tuple[Tensor, None]:  # noqa: ANN401
        first, second, partials = ctx.saved_tensors
        return _spread(first, second, None, partials, upstream[0].contiguous(), 0.0), None


class _L1SsimLoss(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,  # noqa: ANN401
        rendered: Tensor,
        target: Tensor,
        weight: Tensor | None,
        ssim_weight: float,
    ) -> Tensor:
        columns, rows = _grid(rendered)
        sums = torch.empty(columns * rows, dtype=torch.float64, device=rendered.device)
        partials = _room_for_partials(rendered, is_needed=ctx.needs_input_grad[0])
        _compare(rendered, target, weight, None, sums, partials, ssim_weight)
        ctx.save_for_backward(rendered, target, weight, partials)
        ctx.ssim_weight = ssim_weight
        return sums.sum().float()

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *upstream: Tensor) -> tuple[Tensor, None, None, None]:  # noqa: ANN401
        rendered, target, weight, partials = ctx.saved_tensors
        gradient = _spread(rendered, target, weight, partials, upstream[0], ctx.ssim_weight)
        return gradient, None, None, None


def _as_read(*tensors: Tensor) -> tuple[Tensor, ...]:
    return tuple(tensor.float().contiguous() for tensor in tensors)


def _grid(image: Tensor) -> tuple[int, int]:
    """Strips and pieces of them."""
    height, width, channels = image.shape
    return triton.cdiv(channels * width, COLUMNS_AT_ONCE), triton.cdiv(height, ROWS_AT_ONCE)


def _room_for_partials(image: Tensor, *, is_needed: bool) -> Tensor | None:
    """Room for the derivatives of SSIM by the means, by DD and by SS."""
    return image.new_empty((3, *image.shape)) if is_needed else None


def _compare(
    first: Tensor,
    second: Tensor,
    weight: Tensor | None,
    similarity: Tensor | None,
    sums: Tensor | None,
    partials: Tensor | None,
    ssim_weight: float,
) -> None:
    """Fill what is given of the last three."""
    with torch.cuda.device_of(first):
        compare[_grid(first)](
            first,
            second,
            first if weight is None else weight,
            first if similarity is None else similarity,
            first if sums is None else sums,
            first if partials is None else partials,
            first.shape[0],
            first.shape[1],
            float(ssim_weight),
            1.0 / max(first.numel(), 1),
            IS_MAP=similarity is not None,
            WEIGHTED=weight is not None,
            WITH_PARTIALS=partials is not None,
            ROWS=ROWS_AT_ONCE,
            BLOCK=COLUMNS_AT_ONCE,
        )


def _spread(
    first: Tensor,
    second: Tensor,
    weight: Tensor | None,
    partials: Tensor,
    upstream: Tensor,
    ssim_weight: float,
) -> Tensor:
    """The gradient to the first image; upstream is that of the map or, a number, of the loss."""
    gradient = torch.empty_like(first)
    with torch.cuda.device_of(first):
        spread[_grid(first)](
            first,
            second,
            first if weight is None else weight,
            partials,
            upstream,
            gradient,
            first.shape[0],
            first.shape[1],
            ssim_weight,
            1.0 / max(first.numel(), 1),
            IS_MAP=upstream.ndim > 0,
            WEIGHTED=weight is not None,
            ROWS=ROWS_AT_ONCE,
            BLOCK=COLUMNS_AT_ONCE,
        )
    return gradient
