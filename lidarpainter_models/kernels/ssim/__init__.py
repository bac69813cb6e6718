"""Structural similarity (SSIM) of two images, and the image loss of the fit.

The window is 11 x 11, Gaussian, sigma 1.5 px, with zeros outside the image; the dynamic range is
1 (images in [0, 1]). This is the SSIM of Wang et al. (2004) on each colour channel.
"""

from jaxtyping import Float
from torch import Tensor

from lidarpainter_models.errors import ShapeError
from lidarpainter_models.kernels.backends import Backend, implementation


def ssim_map(
    first_rgb: Float[Tensor, "height width 3"],
    second_rgb: Float[Tensor, "height width 3"],
    *,
    backend: Backend = "auto",
) -> Float[Tensor, "height width 3"]:
    """SSIM around every pixel for each channel, in [-1, 1].

    Differentiable in the first image; the second is taken as constant.

    Raises:
        ShapeError: the images differ in shape, or are not (height, width, 3).
        BackendError: the version asked for cannot take the images, see `implementation`.
    """
    _check_images(first_rgb, second_rgb)
    compute = implementation("ssim", "ssim_map", backend, first_rgb.device, dtype=first_rgb.dtype)
    return compute(first_rgb, second_rgb.detach())


def l1_ssim_loss(
    rendered: Float[Tensor, "height width 3"],
    target: Float[Tensor, "height width 3"],
    *,
    ssim_weight: float = 0.2,
    pixel_weight: Float[Tensor, "height width"] | None = None,
    backend: Backend = "auto",
) -> Float[Tensor, ""]:
    """Image loss L1 + ssim_weight (1 - SSIM), weighted by pixel; gradient to `rendered` only.

    With w the pixel weights (1 where none are given; >= 0, usually a confidence in [0, 1]), x the
    rendered image and y the target,

        loss = 1 / (3 height width) * sum over pixels p and channels c of
               w_p ( |x'_pc - y_pc| + ssim_weight (1 - SSIM(x', y)_pc) ),
        x' = x where w > 0, y where w = 0.

    The sum is divided by the number of pixels, not by the sum of the weights: an image trusted by
    half counts half, and one trusted nowhere gives 0. A pixel of weight 0 has no influence through
    x, not even inside the windows of its neighbours, and receives no gradient.

    Raises:
        ShapeError: images or weights do not fit together.
        BackendError: the version asked for cannot take the images, see `implementation`.
    """
    _check_images(rendered, target)
    if pixel_weight is not None and pixel_weight.shape != rendered.shape[:2]:
        raise ShapeError(
            f"need one weight per pixel, got {tuple(pixel_weight.shape)} for an image of "
            f"{tuple(rendered.shape)}"
        )
    weight = None if pixel_weight is None else pixel_weight.detach().to(rendered.dtype)
    compute = implementation("ssim", "l1_ssim_loss", backend, rendered.device, dtype=rendered.dtype)
    return compute(rendered, target.detach(), weight, ssim_weight)


def _check_images(first: Tensor, second: Tensor) -> None:
    if first.shape != second.shape or first.ndim != 3 or first.shape[-1] != 3:
        raise ShapeError(
            f"need two images (height, width, 3) of one size, got {tuple(first.shape)} and "
            f"{tuple(second.shape)}"
        )
    if first.dtype != second.dtype:
        raise ShapeError(f"need images of one dtype, got {first.dtype} and {second.dtype}")
