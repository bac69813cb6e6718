"""Structural similarity in plain torch: the law for the fast version, on any device and dtype.

Wang, Bovik, Sheikh and Simoncelli, "Image quality assessment: from error visibility to structural
similarity" (2004), with the 11 x 11 Gaussian window of that paper and zeros outside the image.
Gradients come from autograd.
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor

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
    first, second = first_rgb.permute(2, 0, 1), second_rgb.permute(2, 0, 1)
    mean_first, mean_second = _blurred(first), _blurred(second)
    variance_first = _blurred(first * first) - mean_first**2
    variance_second = _blurred(second * second) - mean_second**2
    covariance = _blurred(first * second) - mean_first * mean_second
    luminance = (2 * mean_first * mean_second + LUMINANCE_CONSTANT) / (
        mean_first**2 + mean_second**2 + LUMINANCE_CONSTANT
    )
    contrast = (2 * covariance + CONTRAST_CONSTANT) / (
        variance_first + variance_second + CONTRAST_CONSTANT
    )
    return (luminance * contrast).permute(1, 2, 0)


def l1_ssim_loss(
    rendered: Float[Tensor, "height width 3"],
    target: Float[Tensor, "height width 3"],
    pixel_weight: Float[Tensor, "height width"],
    ssim_weight: float,
) -> Float[Tensor, ""]:
    """The loss defined at `lidarpainter_models.kernels.ssim.l1_ssim_loss`."""
    weight = pixel_weight[..., None]
    seen = torch.where(weight > 0, rendered, target)
    difference = (seen - target).abs()
    dissimilarity = 1 - ssim_map(seen, target)
    return (weight * (difference + ssim_weight * dissimilarity)).mean()


def _blurred(channels: Float[Tensor, "3 height width"]) -> Float[Tensor, "3 height width"]:
    """The windowed mean around every pixel, with zeros outside the image."""
    weights = torch.tensor(window_weights(), dtype=channels.dtype, device=channels.device)
    rows = weights.view(1, 1, 1, -1)
    blurred = torch.nn.functional.conv2d(channels[:, None], rows, padding=(0, WINDOW_RADIUS_PX))
    columns = weights.view(1, 1, -1, 1)
    blurred = torch.nn.functional.conv2d(blurred, columns, padding=(WINDOW_RADIUS_PX, 0))
    return blurred[:, 0]
