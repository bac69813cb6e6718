"""What a fit minimises besides the terms per pixel: actors in their boxes, small corrections.

Sky and LiDAR depth are in `pixel_losses`. Lengths are metres, angles radians.
"""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

ACTOR_TERM_EVERY = 10
"""Steps between two actor terms: it needs one more blended channel."""
_EDGE = 1e-4  # keeps logarithms finite


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
