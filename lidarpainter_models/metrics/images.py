"""How close an image comes to the truth, after an affine change of colour where cameras differ.

Images are (height, width, 3) rgb in [0, 1]. PSNR follows 10 log10(1 / MSE) with the squared
error averaged over pixels and channels; SSIM is Wang et al. (2004) as `kernels.ssim` defines it
(11x11 Gaussian window, sigma 1.5, zero padded).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from lidarpainter_models.errors import ShapeError
from lidarpainter_models.kernels.ssim import ssim_map

MIN_PIXELS = 100
"""Fewer samples than this do not pin twelve numbers down."""


def squared_error(
    image: Float[Tensor, "height width 3"], truth: Float[Tensor, "height width 3"]
) -> Float[Tensor, "height width"]:
    """Squared error per pixel, averaged over the channels; the image is clamped to [0, 1].

    Raises:
        ShapeError: the two images differ in size.
    """
    if image.shape != truth.shape:
        raise ShapeError(f"images differ in shape: {tuple(image.shape)} and {tuple(truth.shape)}")
    return (image.clamp(0, 1) - truth).square().mean(dim=-1)


def psnr_from_error(mean_squared_error: float) -> float:
    """Peak signal-to-noise ratio in dB for a peak of 1; a perfect image gives infinity."""
    if mean_squared_error == 0:
        return float("inf")
    return float(-10 * torch.log10(torch.tensor(mean_squared_error, dtype=torch.float64)))


@dataclass(frozen=True, slots=True, kw_only=True)
class ImageScores:
    """One image against the truth."""

    psnr_db: float
    ssim: float
    masked_squared_error: float
    """Sum of squared error inside the mask, for pooling over views."""
    masked_pixels: int


def score_image(
    image: Float[Tensor, "height width 3"],
    truth: Float[Tensor, "height width 3"],
    mask: Bool[Tensor, "height width"] | None = None,
    *,
    hidden: Bool[Tensor, "height width"] | None = None,
) -> ImageScores:
    """PSNR and SSIM of the image where nothing is hidden, and the error inside a mask.

    Where something is hidden the image must be the truth, which spoils no window of SSIM.
    """
    error = squared_error(image, truth).double()
    inside = error[mask] if mask is not None else error.new_zeros(0)
    similarity = ssim_map(image.clamp(0, 1).contiguous(), truth.contiguous())
    if hidden is not None:
        error, similarity = error[~hidden], similarity[~hidden]
    return ImageScores(
        psnr_db=psnr_from_error(float(error.mean())),
        ssim=float(similarity.mean()),
        masked_squared_error=float(inside.sum()),
        masked_pixels=inside.numel(),
    )


def pooled_psnr(scores: Sequence[ImageScores]) -> float | None:
    """PSNR of the masked pixels of all views together; None where no pixel was masked."""
    pixels = sum(score.masked_pixels for score in scores)
    if pixels == 0:
        return None
    return psnr_from_error(sum(score.masked_squared_error for score in scores) / pixels)


def fit_affine_colour(
    source_rgb: Float[Tensor, "pixels 3"], target_rgb: Float[Tensor, "pixels 3"]
) -> Float[Tensor, "3 4"]:
    """Least-squares `target = A source + b` as a 3x4 matrix.

    Raises:
        ShapeError: too few pixels to fit twelve numbers.
    """
    if len(source_rgb) < MIN_PIXELS or source_rgb.shape != target_rgb.shape:
        raise ShapeError(
            f"an affine colour needs at least {MIN_PIXELS} matching pixels, got "
            f"{len(source_rgb)} and {len(target_rgb)}"
        )
    ones = torch.ones_like(source_rgb[:, :1])
    design = torch.cat([source_rgb, ones], dim=1).double()
    solution = torch.linalg.lstsq(design, target_rgb.double()).solution
    return solution.T.to(source_rgb.dtype).contiguous()


def apply_affine_colour(
    rgb: Float[Tensor, "*pixels 3"], affine: Float[Tensor, "3 4"]
) -> Float[Tensor, "*pixels 3"]:
    """Map colours with a 3x4 matrix; the result may leave [0, 1]."""
    return rgb @ affine[:, :3].T + affine[:, 3]
