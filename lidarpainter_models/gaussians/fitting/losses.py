"""What a fit minimises besides the terms per pixel: actors in their boxes, small corrections.

Sky and LiDAR depth are in `pixel_losses`. Lengths are metres, angles radians.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

ACTOR_TERM_EVERY = 10
"""Steps between two actor terms: it needs one more blended channel."""
_EDGE = 1e-4  # keeps logarithms finite


@dataclass(frozen=True, slots=True, kw_only=True)
class FitLossWeights:
    """How much each part of the loss counts."""

    ssim: float = 0.2
    """Of 1 - SSIM beside the mean absolute difference."""
    perceptual: float = 0.0
    """Of the perceptual distance, where one is given to the fit."""
    sky: float = 0.05
    """Of the clear-sky term."""
    sky_tolerance: float = 0.06
    """A pixel without LiDAR return this close to the sky's colour counts as sky: between wires
    the fit would otherwise hang sky-coloured needles at any depth."""
    actors: float = 0.1
    """Of the term that keeps actors inside their boxes."""
    depth: float = 0.05
    """Of the LiDAR depth term."""
    depth_tolerance: float = 0.05
    """Relative depth error from which on the pull of the LiDAR weakens."""
    pose_prior: float = 1e-4
    """Of squared camera corrections in units of the expected noise."""
    actor_prior: float = 1e-6
    """Of squared actor corrections, likewise: an actor fills a small part of the image."""
    actor_smoothness: float = 1e-5
    """Of squared jumps between an actor's neighbouring corrections, likewise."""


def actor_boundary_loss(
    actor_alpha: Float[Tensor, "height width"], in_boxes: Bool[Tensor, "height width"]
) -> Float[Tensor, ""]:
    """Mean of -log(1 - actor_alpha) outside the projected boxes, of its entropy inside."""
    inside = actor_alpha.clamp(_EDGE, 1 - _EDGE)
    log_clear = torch.log1p(-inside)
    entropy = -(inside * inside.log() + (1 - inside) * log_clear)
    return torch.where(in_boxes, entropy, -log_clear).mean()


def pose_prior(
    tangents: Float[Tensor, "rows 6"], *, rotation_rad: float, translation_m: float
) -> Float[Tensor, ""]:
    """Sum of squared corrections in units of the noise that is expected."""
    unit = torch.tensor([rotation_rad] * 3 + [translation_m] * 3, dtype=tangents.dtype)
    return (tangents / unit).square().sum()
