"""One affine colour change between two cameras, fitted where both show the same surface."""

import torch
from jaxtyping import Float
from torch import Tensor

from lidarpainter_models.errors import ShapeError

MIN_PIXELS = 100
"""Fewer samples than this do not pin twelve numbers down."""


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
