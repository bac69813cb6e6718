"""The loss of a fit: what a recorded and what a painted view are compared by.

A recorded view: L1 + w (1 - SSIM), a perceptual distance if one is given, LiDAR depth, a clear sky,
and actors inside their boxes. A painted view: the same image terms by trusted pixel, and depth. How
much each counts is set in `FitLossWeights` and `GuidanceConfig`; priors of poses and bodies are
those of `refinement`.
"""

from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor

from lidarpainter_models.gaussians.fitting.config import FitConfig, FitLossWeights
from lidarpainter_models.gaussians.fitting.images import FitImage
from lidarpainter_models.gaussians.model.scene_rendering import PosedScene
from lidarpainter_models.gaussians.model.sky import MIN_TRANSMITTANCE
from lidarpainter_models.geometry.box_masks import project_boxes
from lidarpainter_models.kernels.gaussian_raster import SplatImage
from lidarpainter_models.kernels.pixel_losses import PixelFacts, PixelRules, pixel_terms
from lidarpainter_models.kernels.pixel_losses.reference import clear_sky_loss, depth_loss
from lidarpainter_models.kernels.ssim import l1_ssim_loss
from lidarpainter_models.observations.views import GuidanceView

SKY_TOLERANCE = 0.06
"""A pixel without LiDAR return this close to the sky's colour counts as sky: between wires the fit
would otherwise hang sky-coloured needles at any depth."""
DEPTH_TOLERANCE = 0.05
"""Relative depth error from which on the pull of the LiDAR weakens."""
ACTOR_TERM_EVERY = 10
"""Steps between two actor terms: it needs one more blended channel."""
RULES = PixelRules(
    sky_tolerance=SKY_TOLERANCE,
    depth_tolerance=DEPTH_TOLERANCE,
    min_transmittance=MIN_TRANSMITTANCE,
)
_EDGE = 1e-4  # keeps logarithms finite

Perceptual = Callable[
    [Float[Tensor, "height width 3"], Float[Tensor, "height width 3"]], Float[Tensor, ""]
]
"""Distance of a rendered and a true image, differentiable in the first."""


def recorded_loss(
    splat: SplatImage,
    sky_rgb: Float[Tensor, "height width 3"],
    image: FitImage,
    facts: PixelFacts,
    weights: FitLossWeights,
    *,
    exposure: Float[Tensor, "3 4"] | None,
    perceptual: Perceptual | None,
) -> tuple[Float[Tensor, ""], Float[Tensor, "height width 3"]]:
    """Return the loss of a recorded view without its actors' term, and what the view shows.

    Nothing is learnt from hidden pixels of the image, whose `facts` are the same as floats.
    """
    terms = pixel_terms(splat, sky_rgb, facts, RULES, exposure=exposure)
    shown = terms.shown
    if image.hidden is not None:
        shown = torch.where(image.hidden[..., None], facts.rgb, shown)
    loss = l1_ssim_loss(shown, facts.rgb, ssim_weight=weights.ssim)
    if perceptual is not None and weights.perceptual > 0:
        loss = loss + weights.perceptual * perceptual(shown, facts.rgb)
    return loss + weights.sky * terms.sky + weights.depth * terms.depth, shown


def painted_loss(
    splat: SplatImage,
    sky_rgb: Float[Tensor, "height width 3"],
    view: GuidanceView,
    config: FitConfig,
    perceptual: Perceptual | None,
) -> Float[Tensor, ""]:
    """Return the loss of a painted view.

    What LiDAR hit is opaque there as on recorded views. The depth term alone is content with ever
    less of what is there, and wears away what recorded views do not hold.
    """
    settings = config.guidance
    shown = splat.rgb + (1 - splat.alpha)[..., None] * sky_rgb
    loss = settings.weight * l1_ssim_loss(
        shown, view.rgb, ssim_weight=settings.ssim, pixel_weight=view.weight
    )
    if perceptual is not None and settings.perceptual > 0:
        trusted = view.rgb + view.weight[..., None] * (shown - view.rgb)
        distance = perceptual(trusted, view.rgb)
        loss = loss + settings.weight * settings.perceptual * distance
    if settings.depth > 0:
        loss = loss + settings.depth * depth_loss(
            splat.depth_m, splat.alpha, view.lidar_depth_m, tolerance=DEPTH_TOLERANCE
        )
    is_hit = view.lidar_depth_m > 0
    return loss + config.losses.sky * clear_sky_loss(splat.alpha, torch.zeros_like(is_hit), is_hit)


def actor_loss(splat: SplatImage, posed: PosedScene) -> Float[Tensor, ""]:
    """Return how far actors show outside their projected boxes; the splat has their channel.

    The mean of -log(1 - alpha) of the actors outside, of the entropy of alpha inside.
    """
    world_from_actors, present = posed.poses
    sizes = [track.size_m for track in posed.actors.recorded_tracks]
    in_boxes = project_boxes(posed.camera, world_from_actors.detach(), sizes, present > 0)
    in_boxes = in_boxes.to(splat.alpha.device, non_blocking=True)
    inside = splat.features[..., 0].clamp(_EDGE, 1 - _EDGE)
    log_clear = torch.log1p(-inside)
    entropy = -(inside * inside.log() + (1 - inside) * log_clear)
    return torch.where(in_boxes, entropy, -log_clear).mean()
