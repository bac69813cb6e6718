"""Structural similarity and its gradient with numba: passes over rows of float32.

With d = first - second and s = first + second - 1, blurred by the window to D, S and the blurs of
the squares DD, SS, the definition of Wang et al. (2004) becomes

    SSIM = (1 - D^2 / (M + c1)) (1 - (DD - D^2) / (V + c2)),
    M = ((S + 1)^2 + D^2) / 2,  V = (SS - S^2 + DD - D^2) / 2,

which needs four blurs instead of five and keeps its digits where the two images agree (the 1
keeps s small, so that SS - S^2 cancels less; outside the image s is -1). The gradient needs
three more blurs: those of dSSIM/dD + dSSIM/dS, dSSIM/dDD and dSSIM/dSS. Every output row is
computed by one thread in one order, so the number of threads changes no bit.
"""

import numba
import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import BackwardCFunction

from lidarpainter_models.kernels.ssim.reference import (
    CONTRAST_CONSTANT,
    LUMINANCE_CONSTANT,
    WINDOW_RADIUS_PX,
    window_weights,
)

CHANNELS = 3
RADIUS = WINDOW_RADIUS_PX
PAD = RADIUS * CHANNELS
# the window is symmetric: its centre and then one side
W0, W1, W2, W3, W4, W5 = (np.float32(w) for w in window_weights()[RADIUS:])
C1, C2 = np.float32(LUMINANCE_CONSTANT), np.float32(CONTRAST_CONSTANT)
ZERO, HALF, ONE, TWO = np.float32(0), np.float32(0.5), np.float32(1), np.float32(2)
# d, s and their squares where both images are zero
OUTSIDE = np.array([0, -1, 0, 1], dtype=np.float32)
_CONTRACT = {"contract"}  # fused multiply-add; sums keep their order


def ssim_map(first_rgb: Tensor, second_rgb: Tensor) -> Tensor:
    """SSIM around every pixel; differentiable in the first image."""
    return _SsimMap.apply(first_rgb, second_rgb)


def l1_ssim_loss(
    rendered: Tensor, target: Tensor, pixel_weight: Tensor | None, ssim_weight: float
) -> Tensor:
    """The fused loss; its gradient is computed along with it."""
    if pixel_weight is None:
        pixel_weight = torch.ones_like(rendered[..., 0])
    return _L1SsimLoss.apply(rendered, target, pixel_weight, ssim_weight)


class _SsimMap(torch.autograd.Function):
    @staticmethod
    def forward(ctx: BackwardCFunction, first_rgb: Tensor, second_rgb: Tensor) -> Tensor:
        ctx.save_for_backward(first_rgb, second_rgb)
        first, second = _rows(first_rgb), _rows(second_rgb)
        similarity = _similarity_rows(_blurred_along_rows(first, second))
        return torch.from_numpy(similarity).view(first_rgb.shape)

    @staticmethod
    def backward(ctx: BackwardCFunction, *grad_outputs: Tensor) -> tuple[Tensor, None]:
        (gradient,) = grad_outputs
        first, second = (_rows(image) for image in ctx.saved_tensors)
        _, partials = _partial_rows(_blurred_along_rows(first, second), _rows(gradient))
        gradient_first = _gradient_rows(first, second, partials)
        return torch.from_numpy(gradient_first).view(gradient.shape), None


class _L1SsimLoss(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: BackwardCFunction,
        rendered: Tensor,
        target: Tensor,
        pixel_weight: Tensor,
        ssim_weight: float,
    ) -> Tensor:
        second, weight = _rows(target), _rows(pixel_weight)
        scale = np.float32(1 / rendered.numel())
        first, upstream, absolute = _weighted_rows(_rows(rendered), second, weight)
        blurs = _blurred_along_rows(first, second)
        if ctx.needs_input_grad[0]:
            similarity, partials = _partial_rows(blurs, upstream)
            gradient = _gradient_rows(first, second, partials)
            _finish_gradient(first, second, upstream, gradient, np.float32(ssim_weight), scale)
            ctx.save_for_backward(torch.from_numpy(gradient).view(rendered.shape))
        else:
            similarity = _similarity_rows(blurs)
        dissimilarity = _weighted_dissimilarity(similarity, upstream)
        loss = (absolute.sum() + ssim_weight * dissimilarity.sum()) / rendered.numel()
        return torch.tensor(loss, dtype=torch.float32)

    @staticmethod
    def backward(ctx: BackwardCFunction, *grad_outputs: Tensor) -> tuple[Tensor, None, None, None]:
        (gradient_of_unit,) = ctx.saved_tensors
        return gradient_of_unit * grad_outputs[0], None, None, None


def _rows(image: Tensor) -> np.ndarray:
    """An image (height, width, 3) as rows of interleaved channels; (height, width) as it is."""
    return image.detach().contiguous().flatten(1).numpy()


@numba.njit(cache=True, nogil=True, parallel=True, fastmath=_CONTRACT)
def _weighted_rows(
    rendered: np.ndarray, target: np.ndarray, weight: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rendered rows with unweighted pixels replaced, weights per channel, weighted L1 of rows."""
    height, length = rendered.shape
    first, upstream = np.empty_like(rendered), np.empty_like(rendered)
    absolute = np.empty(height, dtype=np.float64)
    for row in numba.prange(height):
        total = 0.0
        for i in range(length):
            w = weight[row, i // CHANNELS]
            first[row, i] = rendered[row, i] if w > ZERO else target[row, i]
            upstream[row, i] = w
            total += w * abs(first[row, i] - target[row, i])
        absolute[row] = total
    return first, upstream, absolute


@numba.njit(cache=True, nogil=True, fastmath=_CONTRACT, inline="always")
def _blur_row(padded: np.ndarray, blurred: np.ndarray) -> None:
    """Blur one row of interleaved channels that has `PAD` zeros on both sides."""
    for i in range(blurred.shape[0]):
        c = i + PAD
        blurred[i] = (
            W0 * padded[c]
            + W1 * (padded[c - 3] + padded[c + 3])
            + W2 * (padded[c - 6] + padded[c + 6])
            + W3 * (padded[c - 9] + padded[c + 9])
            + W4 * (padded[c - 12] + padded[c + 12])
            + W5 * (padded[c - 15] + padded[c + 15])
        )


@numba.njit(cache=True, nogil=True, fastmath=_CONTRACT, inline="always")
def _blur_column(padded_rows: np.ndarray, row: int, blurred: np.ndarray) -> None:
    """Blur across the rows around `row` of an array with `RADIUS` rows of zeros at both ends."""
    r = row + RADIUS
    for i in range(blurred.shape[0]):
        blurred[i] = (
            W0 * padded_rows[r, i]
            + W1 * (padded_rows[r - 1, i] + padded_rows[r + 1, i])
            + W2 * (padded_rows[r - 2, i] + padded_rows[r + 2, i])
            + W3 * (padded_rows[r - 3, i] + padded_rows[r + 3, i])
            + W4 * (padded_rows[r - 4, i] + padded_rows[r + 4, i])
            + W5 * (padded_rows[r - 5, i] + padded_rows[r + 5, i])
        )


@numba.njit(cache=True, nogil=True)
def _padded_rows(outside: np.ndarray, height: int, length: int) -> np.ndarray:
    """Room for the row blurs of some fields, with rows of their outside value above and below."""
    rows = np.empty((outside.shape[0], height + 2 * RADIUS, length), dtype=np.float32)
    for field in range(outside.shape[0]):
        rows[field, :RADIUS] = outside[field]
        rows[field, height + RADIUS :] = outside[field]
    return rows


@numba.njit(cache=True, nogil=True, parallel=True, fastmath=_CONTRACT)
def _blurred_along_rows(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Row blurs of d, s, d^2 and s^2: (4, height + 2 RADIUS, 3 width)."""
    height, length = first.shape
    blurs = _padded_rows(OUTSIDE, height, length)
    for row in numba.prange(height):
        padded = np.empty((4, length + 2 * PAD), dtype=np.float32)
        for field in range(4):
            padded[field, :PAD] = OUTSIDE[field]
            padded[field, length + PAD :] = OUTSIDE[field]
        for i in range(length):
            difference = first[row, i] - second[row, i]
            total = first[row, i] + second[row, i] - ONE
            padded[0, i + PAD] = difference
            padded[1, i + PAD] = total
            padded[2, i + PAD] = difference * difference
            padded[3, i + PAD] = total * total
        for field in range(4):
            _blur_row(padded[field], blurs[field, row + RADIUS])
    return blurs


@numba.njit(cache=True, nogil=True, parallel=True, fastmath=_CONTRACT)
def _similarity_rows(blurs: np.ndarray) -> np.ndarray:
    """The SSIM map from the row blurs."""
    height, length = blurs.shape[1] - 2 * RADIUS, blurs.shape[2]
    similarity = np.empty((height, length), dtype=np.float32)
    for row in numba.prange(height):
        blurred = np.empty((4, length), dtype=np.float32)
        for field in range(4):
            _blur_column(blurs[field], row, blurred[field])
        for i in range(length):
            mean_d, mean_s = blurred[0, i], blurred[1, i]
            square_d, full_s = mean_d * mean_d, mean_s + ONE
            variance_d, variance_s = blurred[2, i] - square_d, blurred[3, i] - mean_s * mean_s
            luminance = ONE - square_d / (HALF * (full_s * full_s + square_d) + C1)
            contrast = ONE - variance_d / (HALF * (variance_s + variance_d) + C2)
            similarity[row, i] = luminance * contrast
    return similarity


@numba.njit(cache=True, nogil=True, parallel=True, fastmath=_CONTRACT)
def _partial_rows(blurs: np.ndarray, upstream: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The SSIM map and the row blurs of `upstream` times its three partial derivatives."""
    height, length = upstream.shape
    similarity = np.empty((height, length), dtype=np.float32)
    partials = _padded_rows(np.zeros(3, dtype=np.float32), height, length)
    for row in numba.prange(height):
        blurred = np.empty((4, length), dtype=np.float32)
        padded = np.zeros((3, length + 2 * PAD), dtype=np.float32)
        for field in range(4):
            _blur_column(blurs[field], row, blurred[field])
        for i in range(length):
            mean_d, mean_s = blurred[0, i], blurred[1, i]
            square_d, full_s = mean_d * mean_d, mean_s + ONE
            variance_d, variance_s = blurred[2, i] - square_d, blurred[3, i] - mean_s * mean_s
            inverse_m = ONE / (HALF * (full_s * full_s + square_d) + C1)
            inverse_v = ONE / (HALF * (variance_s + variance_d) + C2)
            a, b = square_d * inverse_m, variance_d * inverse_v
            similarity[row, i] = (ONE - a) * (ONE - b)
            by_a, by_b = (b - ONE) * upstream[row, i], (a - ONE) * upstream[row, i] * inverse_v
            by_mean = inverse_m * (mean_d * (TWO - a) - a * full_s)
            padded[0, i + PAD] = by_a * by_mean + by_b * (b * (mean_d + mean_s) - TWO * mean_d)
            padded[1, i + PAD] = by_b * (ONE - HALF * b)
            padded[2, i + PAD] = -HALF * b * by_b
        for field in range(3):
            _blur_row(padded[field], partials[field, row + RADIUS])
    return similarity, partials


@numba.njit(cache=True, nogil=True, parallel=True, fastmath=_CONTRACT)
def _gradient_rows(first: np.ndarray, second: np.ndarray, partials: np.ndarray) -> np.ndarray:
    """The gradient to `first` of the sum of upstream times SSIM."""
    height, length = first.shape
    gradient = np.empty((height, length), dtype=np.float32)
    for row in numba.prange(height):
        blurred = np.empty((3, length), dtype=np.float32)
        for field in range(3):
            _blur_column(partials[field], row, blurred[field])
        for i in range(length):
            difference = first[row, i] - second[row, i]
            total = first[row, i] + second[row, i] - ONE
            gradient[row, i] = blurred[0, i] + TWO * (
                difference * blurred[1, i] + total * blurred[2, i]
            )
    return gradient


@numba.njit(cache=True, nogil=True, parallel=True, fastmath=_CONTRACT)
def _finish_gradient(
    first: np.ndarray,
    second: np.ndarray,
    weight: np.ndarray,
    gradient: np.ndarray,
    ssim_weight: np.float32,
    scale: np.float32,
) -> None:
    """Turn the gradient of the weighted SSIM sum into that of the loss, in place."""
    for row in numba.prange(first.shape[0]):
        for i in range(first.shape[1]):
            sign = np.sign(first[row, i] - second[row, i])
            full = scale * (weight[row, i] * sign - ssim_weight * gradient[row, i])
            gradient[row, i] = full if weight[row, i] > ZERO else ZERO


@numba.njit(cache=True, nogil=True, parallel=True, fastmath=_CONTRACT)
def _weighted_dissimilarity(similarity: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Sum over each row of weight (1 - SSIM), float64."""
    sums = np.empty(similarity.shape[0], dtype=np.float64)
    for row in numba.prange(similarity.shape[0]):
        total = 0.0
        for i in range(similarity.shape[1]):
            total += weight[row, i] * (ONE - similarity[row, i])
        sums[row] = total
    return sums
