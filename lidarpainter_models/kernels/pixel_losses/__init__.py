"""A drawn image over its sky, with the terms that need no second image: sky and depth.

The regularisers are those that StreetCrafter (Yan et al., 2025) calls L_g: the sky stays clear,
LiDAR says how far things are. Depth is camera z in metres, alpha the opacity of the Gaussians.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from lidarpainter_models.errors import ShapeError
from lidarpainter_models.kernels.backends import Backend, implementation
from lidarpainter_models.kernels.gaussian_raster import SplatImage

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


def pixel_terms(
    image: SplatImage,
    sky_rgb: Float[Tensor, "height width 3"],
    facts: PixelFacts,
    rules: PixelRules,
    *,
    exposure: Float[Tensor, "3 4"] | None = None,
    backend: Backend = "auto",
) -> PixelTerms:
    """Put a drawn image over its sky and judge its alpha and depth; differentiable.

    `exposure` maps the colours of the scene to those that the camera shows, the last column being
    added; without it they are shown as they are.

    Raises:
        ShapeError: the images differ in size.
    """
    size = image.alpha.shape
    for name, tensor in (("sky_rgb", sky_rgb), ("rgb", facts.rgb), ("depth", facts.lidar_depth_m)):
        if tensor.shape[:2] != size:
            raise ShapeError(f"an image of {tuple(size)} needs {name} alike, got {tensor.shape}")
    rgb = image.rgb
    terms = implementation("pixel_losses", "pixel_terms", backend, rgb.device, dtype=rgb.dtype)
    if exposure is None:
        exposure = torch.eye(3, 4).to(rgb, non_blocking=True)
    return terms(image, sky_rgb, facts, rules, exposure)
