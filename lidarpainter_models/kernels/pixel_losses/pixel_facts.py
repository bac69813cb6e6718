"""What is known of the pixels of a recorded image, and what a drawn one is judged by."""

from dataclasses import dataclass

from jaxtyping import Float, UInt8
from torch import Tensor

NOTHING, SKY, SOLID, OPEN = 0, 1, 2, 3
"""Kinds of pixels."""


@dataclass(frozen=True, kw_only=True, eq=False)
class PixelFacts:
    """What is known of each pixel of a recorded image."""

    rgb: Float[Tensor, "height width 3"]
    kind: UInt8[Tensor, "height width"]
    """SKY by its mask; SOLID beside a LiDAR return; OPEN without one, where some view has sky."""
    lidar_depth_m: Float[Tensor, "height width"]
    """0 where no point falls."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PixelRules:
    """Thresholds from which on a pixel counts."""

    sky_tolerance: float
    """An OPEN pixel this close to the sky's colour counts as sky."""
    depth_tolerance: float
    """Relative depth error beyond which the pull of the LiDAR weakens."""
    min_transmittance: float
    """The sky receives a gradient only where more of it passes, for Adam would take any trace for
    a call to move."""


@dataclass(frozen=True, kw_only=True, eq=False)
class PixelTerms:
    """The image as shown, and two means over it."""

    shown: Float[Tensor, "height width 3"]
    """Gaussians over sky, exposed."""
    sky: Float[Tensor, ""]
    """See `reference.clear_sky_loss`."""
    depth: Float[Tensor, ""]
    """See `reference.depth_loss`."""
