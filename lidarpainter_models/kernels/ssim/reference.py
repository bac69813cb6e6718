"""Structural similarity in plain torch: the law for the fast version, on any device and dtype.

Wang, Bovik, Sheikh and Simoncelli, "Image quality assessment: from error visibility to structural
similarity" (2004), with the 11 x 11 Gaussian window of that paper and zeros outside the image.
The window is its own transpose, so gradients are means as well.
"""

import math
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import conv2d

WINDOW_RADIUS_PX = 5
WINDOW_SIGMA_PX = 1.5
LUMINANCE_CONSTANT = 0.01**2
CONTRAST_CONSTANT = 0.03**2


def window_weights() -> tuple[float, ...]:
    """The eleven weights of the window along one axis; they add up to 1."""
    offsets = range(-WINDOW_RADIUS_PX, WINDOW_RADIUS_PX + 1)
    weights = [math.exp(-(offset**2) / (2 * WINDOW_SIGMA_PX**2)) for offset in offsets]
    return tuple(weight / sum(weights) for weight in weights)


def ssim_map(
    first_rgb: Float[Tensor, "height width 3"], second_rgb: Float[Tensor, "height width 3"]
) -> Float[Tensor, "height width 3"]:
    """SSIM around every pixel, for each channel alone, in [-1, 1]."""
    similarity: Tensor = _Ssim.apply(_planes(first_rgb), _planes(second_rgb))
    return similarity.permute(1, 2, 0)


def l1_ssim_loss(
    rendered: Float[Tensor, "height width 3"],
    target: Float[Tensor, "height width 3"],
    pixel_weight: Float[Tensor, "height width"] | None,
    ssim_weight: float,
) -> Float[Tensor, ""]:
    """The loss defined at `lidarpainter_models.kernels.ssim.l1_ssim_loss`."""
    seen, target = _planes(rendered), _planes(target)
    if pixel_weight is not None:
        seen = torch.where(pixel_weight > 0, seen, target)
    badness = (seen - target).abs() + ssim_weight * (1 - _Ssim.apply(seen, target))
    return (badness if pixel_weight is None else pixel_weight * badness).mean()


class _Ssim(torch.autograd.Function):
    """S = A B / (C D) of windowed means; a derivative by a mean is blurred back to the pixels."""

    @staticmethod
    def forward(ctx: Any, first: Tensor, second: Tensor) -> Tensor:  # noqa: ANN401
        planes = torch.cat([first, second, first * first + second * second, first * second])
        mean_1, mean_2, squares, product = _blurred(planes).split(3)
        both, of_means = mean_1 * mean_2, mean_1**2 + mean_2**2
        a, c = 2 * both + LUMINANCE_CONSTANT, of_means + LUMINANCE_CONSTANT
        b, d = 2 * (product - both) + CONTRAST_CONSTANT, squares - of_means + CONTRAST_CONSTANT
        ctx.save_for_backward(first, second, mean_1, mean_2, a, b, c, d)
        return a * b / (c * d)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None]:  # noqa: ANN401
        first, second, mean_1, mean_2, a, b, c, d = ctx.saved_tensors
        share = gradient / (c * d)
        by_squares = -share * a * b / d
        by_mean = 2 * (share * mean_2 * (b - a) + by_squares * mean_1 * (d / c - 1))
        planes = torch.cat([by_mean, by_squares, 2 * share * a])
        mean, square, product = _blurred(planes).split(3)
        return mean + 2 * first * square + second * product, None


def _planes(rgb: Float[Tensor, "height width 3"]) -> Float[Tensor, "3 height width"]:
    return rgb.permute(2, 0, 1).contiguous()


def _blurred(planes: Float[Tensor, "planes height width"]) -> Float[Tensor, "planes height width"]:
    """The windowed mean around every pixel, with zeros outside the image; all planes at once."""
    count, height, width = planes.shape
    offset = torch.arange(
        -WINDOW_RADIUS_PX, WINDOW_RADIUS_PX + 1, dtype=planes.dtype, device=planes.device
    )
    weights = torch.exp(-(offset**2) / (2 * WINDOW_SIGMA_PX**2))
    weights = (weights / weights.sum()).expand(count, 1, 1, -1).contiguous()
    # pixel by pixel in memory, as such convolutions are fastest; turned as matrices, which is fast
    image = planes.view(count, -1).t().contiguous().view(1, height, width, count).movedim(-1, 1)
    image = conv2d(image, weights, padding=(0, WINDOW_RADIUS_PX), groups=count)
    image = conv2d(image, weights.mT, padding=(WINDOW_RADIUS_PX, 0), groups=count)
    return image.movedim(1, -1).reshape(-1, count).t().contiguous().view(count, height, width)
