"""The terms of a drawn image in plain torch: the law for the fast version, on any device."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from lidarpainter_models.kernels.gaussian_raster import SplatImage
from lidarpainter_models.kernels.pixel_losses import (
    OPEN,
    SKY,
    SOLID,
    PixelFacts,
    PixelRules,
    PixelTerms,
)

ALPHA_EDGE = 1e-4
"""Keeps logarithms finite."""
LEAST_KNOWN_ALPHA = 0.3
"""The expected depth of a clearer pixel means nothing."""


def pixel_terms(
    image: SplatImage,
    sky_rgb: Float[Tensor, "height width 3"],
    facts: PixelFacts,
    rules: PixelRules,
    exposure: Float[Tensor, "3 4"],
) -> PixelTerms:
    """See `pixel_losses.pixel_terms`."""
    composed_rgb = composed(image, sky_rgb, rules.min_transmittance)
    is_open = facts.kind == OPEN
    shown_sky = exposed(sky_rgb, exposure).detach()
    like_sky = looks_like_sky(facts.rgb, shown_sky, is_open, tolerance=rules.sky_tolerance)
    return PixelTerms(
        shown=exposed(composed_rgb, exposure),
        sky=clear_sky_loss(image.alpha, (facts.kind == SKY) | like_sky, facts.kind == SOLID),
        depth=depth_loss(
            image.depth_m, image.alpha, facts.lidar_depth_m, tolerance=rules.depth_tolerance
        ),
    )


def exposed(
    rgb: Float[Tensor, "height width 3"], exposure: Float[Tensor, "3 4"]
) -> Float[Tensor, "height width 3"]:
    """Colours as a camera shows them."""
    return rgb @ exposure[:, :3].T + exposure[:, 3]


def composed(
    image: SplatImage, sky_rgb: Float[Tensor, "height width 3"], min_transmittance: float
) -> Float[Tensor, "height width 3"]:
    """Gaussians over sky; the sky gets a gradient only where it is seen clearly enough."""
    clear = (1 - image.alpha)[..., None]
    gated = torch.where(clear.detach() > min_transmittance, sky_rgb, sky_rgb.detach())
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
    inside = alpha.clamp(ALPHA_EDGE, 1 - ALPHA_EDGE)
    wanted = torch.where(sky_mask, 1 - inside, inside)
    return -torch.where(sky_mask | solid_mask, wanted.log(), torch.zeros_like(alpha)).mean()


def looks_like_sky(
    rgb: Float[Tensor, "height width 3"],
    sky_rgb: Float[Tensor, "height width 3"],
    open_mask: Bool[Tensor, "height width"],
    *,
    tolerance: float,
) -> Bool[Tensor, "height width"]:
    """Open pixels that show the colour which the sky has in their direction, exposed like them.

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
    is_known = (lidar_depth_m > 0) & (alpha.detach() > LEAST_KNOWN_ALPHA)
    safe_m = torch.where(is_known, lidar_depth_m, torch.ones_like(lidar_depth_m))
    expected_m = accumulated_m / alpha.clamp(min=0.05)
    error = torch.log1p((expected_m - safe_m).abs() / (safe_m * tolerance))
    return (error * is_known).sum() / is_known.sum().clamp(min=1)
