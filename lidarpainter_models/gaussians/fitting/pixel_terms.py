"""A drawn image over its sky, with the terms that need no second image: sky and depth.

The regularisers are those that StreetCrafter (Yan et al., 2025) calls L_g: the sky stays clear,
LiDAR says how far things are. Depth is camera z in metres, alpha the opacity of the Gaussians.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from lidarpainter_models.kernels.gaussian_raster import SplatImage
from lidarpainter_models.kernels.pixel_losses import cpu as pixel_kernels

_EDGE = 1e-4  # keeps logarithms finite
NOTHING, SKY, SOLID, OPEN = 0, 1, 2, 3


@dataclass(frozen=True, kw_only=True, eq=False)
class PixelFacts:
    """What is known of each pixel of a recorded image."""

    rgb: Float[Tensor, "height width 3"]
    kind: UInt8[Tensor, "height width"]
    """SKY by its mask; SOLID beside a LiDAR return; OPEN without one, where some view has sky."""
    lidar_depth_m: Float[Tensor, "height width"]
    """0 where no point falls."""


@dataclass(frozen=True, kw_only=True, eq=False)
class PixelTerms:
    """The image as shown, and two means over it."""

    shown: Float[Tensor, "height width 3"]
    """Gaussians over sky."""
    sky: Float[Tensor, ""]
    """See `clear_sky_loss`."""
    depth: Float[Tensor, ""]
    """See `depth_loss`."""


def pixel_terms(
    image: SplatImage,
    sky_rgb: Float[Tensor, "height width 3"],
    facts: PixelFacts,
    *,
    sky_tolerance: float,
    depth_tolerance: float,
    least_clear: float,
) -> PixelTerms:
    """Put a drawn image over its sky and judge its alpha and depth.

    Args:
        image: what the Gaussians show.
        sky_rgb: the sky's colour in every pixel; it receives a gradient only where more than
            `least_clear` of it passes, for Adam would take any trace for a call to move.
        facts: see there.
        sky_tolerance: an OPEN pixel this close to the sky's colour counts as sky.
        depth_tolerance: see `depth_loss`.
        least_clear: see `sky_rgb`.
    """
    if image.rgb.device.type == "cpu":
        constants = (
            facts.rgb,
            facts.kind,
            facts.lidar_depth_m,
            (sky_tolerance, depth_tolerance),
            least_clear,
        )
        shown, sky, depth = pixel_kernels.PixelTerms.apply(
            image.rgb, image.depth_m, image.alpha, sky_rgb, constants
        )
        return PixelTerms(shown=shown, sky=sky, depth=depth)
    return pixel_terms_reference(
        image,
        sky_rgb,
        facts,
        sky_tolerance=sky_tolerance,
        depth_tolerance=depth_tolerance,
        least_clear=least_clear,
    )


def pixel_terms_reference(
    image: SplatImage,
    sky_rgb: Float[Tensor, "height width 3"],
    facts: PixelFacts,
    *,
    sky_tolerance: float,
    depth_tolerance: float,
    least_clear: float,
) -> PixelTerms:
    """Plain torch twin of `pixel_terms`."""
    is_open = facts.kind == OPEN
    like_sky = looks_like_sky(facts.rgb, sky_rgb.detach(), is_open, tolerance=sky_tolerance)
    return PixelTerms(
        shown=composed(image, sky_rgb, least_clear),
        sky=clear_sky_loss(image.alpha, (facts.kind == SKY) | like_sky, facts.kind == SOLID),
        depth=depth_loss(
            image.depth_m, image.alpha, facts.lidar_depth_m, tolerance=depth_tolerance
        ),
    )


def composed(
    image: SplatImage, sky_rgb: Float[Tensor, "height width 3"], least_clear: float
) -> Float[Tensor, "height width 3"]:
    """Gaussians over sky; the sky gets a gradient only where it is seen clearly enough."""
    clear = (1 - image.alpha)[..., None]
    gated = torch.where(clear.detach() > least_clear, sky_rgb, sky_rgb.detach())
    return image.rgb + clear * gated


def clear_sky_loss(
    alpha: Float[Tensor, "height width"],
    sky_mask: Bool[Tensor, "height width"],
    solid_mask: Bool[Tensor, "height width"],
) -> Float[Tensor, ""]:
    """Mean of -log(1 - alpha) in the sky and of -log(alpha) where LiDAR hit something.

    StreetCrafter takes the entropy of alpha everywhere outside the sky; that also closes the gaps
    between wires and branches, which are neither sky for certain nor solid. Those that look like
    the sky behind them are better counted as sky (`looks_like_sky`), the others are left alone.
    """
    inside = alpha.clamp(_EDGE, 1 - _EDGE)
    wanted = torch.where(sky_mask, 1 - inside, inside)
    return -torch.where(sky_mask | solid_mask, wanted.log(), torch.zeros_like(alpha)).mean()


def looks_like_sky(
    rgb: Float[Tensor, "height width 3"],
    sky_rgb: Float[Tensor, "height width 3"],
    open_mask: Bool[Tensor, "height width"],
    *,
    tolerance: float,
) -> Bool[Tensor, "height width"]:
    """Open pixels that show the colour which the sky has in their direction.

    Where no view has sky its colour is a continuation of what lies around, far towers included;
    such pixels must not be OPEN, or the towers would be given to the sky.
    """
    return ((rgb - sky_rgb).abs().amax(dim=-1) < tolerance) & open_mask


def depth_loss(
    accumulated_m: Float[Tensor, "height width"],
    alpha: Float[Tensor, "height width"],
    lidar_depth_m: Float[Tensor, "height width"],
    *,
    tolerance: float,
) -> Float[Tensor, ""]:
    """Robust relative error of the expected depth where LiDAR hit, as a mean over those pixels.

    With e the relative error, log(1 + e / tolerance): the pull weakens beyond the tolerance (an
    occlusion more likely than a wrong surface) but never ends. Pixels that the Gaussians leave
    clear do not count: their expected depth means nothing.
    """
    is_known = (lidar_depth_m > 0) & (alpha.detach() > 0.3)
    safe_m = torch.where(is_known, lidar_depth_m, torch.ones_like(lidar_depth_m))
    expected_m = accumulated_m / alpha.clamp(min=0.05)
    error = torch.log1p((expected_m - safe_m).abs() / (safe_m * tolerance))
    return (error * is_known).sum() / is_known.sum().clamp(min=1)
