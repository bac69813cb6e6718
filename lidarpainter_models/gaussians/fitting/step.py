"""One step of a fit: gradients of a recorded view and perhaps a painted one, and the optimisers.

Only the Gaussians that these views can show take part (`seen_gaussians`). Gaussians, sky and images
lie on the device of the scene; poses (float64) and exposure, a few small matrices a step, on the
CPU.
"""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from lidarpainter_models.gaussians.fitting.config import FitConfig
from lidarpainter_models.gaussians.fitting.hidden_gaussians import probed
from lidarpainter_models.gaussians.fitting.images import FitImage
from lidarpainter_models.gaussians.fitting.state import FitState
from lidarpainter_models.gaussians.model.posed_scene import PosedScene
from lidarpainter_models.gaussians.model.scene_rendering import OPAQUE
from lidarpainter_models.gaussians.model.seen_gaussians import SeenGaussians
from lidarpainter_models.gaussians.model.sky import (
    FINAL_LEARNING_RATE,
    LEARNING_RATE,
    MIN_TRANSMITTANCE,
)
from lidarpainter_models.geometry.box_masks import project_boxes
from lidarpainter_models.kernels.gaussian_raster import SplatImage
from lidarpainter_models.kernels.pixel_losses import (
    SKY,
    PixelRules,
    clear_sky_loss,
    depth_loss,
    pixel_terms,
)
from lidarpainter_models.kernels.side_by_side import both
from lidarpainter_models.kernels.sky_texture import SkyRays
from lidarpainter_models.kernels.ssim import l1_ssim_loss
from lidarpainter_models.observations.views import GuidanceView

ACTOR_TERM_EVERY = 10
"""Steps between two actor terms: it needs one more blended channel."""
_EDGE = 1e-4  # keeps logarithms finite
WAITS = 4
"""The most of the host for the device in a step, without the rasteriser's own: how many Gaussians
are in view, how many of them lag and by how much (plain torch alone asks), and the gradients of the
bodies' poses and of the exposure. Where somebody bends, one more for each view: which Gaussians
do; where lamps blink, two more for each: which are in one; for each that looks at everything, one:
which of it shows nothing."""

Perceptual = Callable[
    [Float[Tensor, "height width 3"], Float[Tensor, "height width 3"]], Float[Tensor, ""]
]
"""Distance of a rendered and a true image, differentiable in the first."""


def fit_step(
    state: FitState,
    image: FitImage,
    row: int,
    guidance: tuple[int, GuidanceView] | None,
    config: FitConfig,
    perceptual: Perceptual | None,
) -> Float[Tensor, "2"]:
    """Step everything by one recorded view, the `row`-th, and a painted one if it is given.

    A painted view comes with its place among all of them.

    Returns the loss and the mean squared error of the recorded image, where the scene lies.
    """
    pose = state.refinement.world_from_camera(row, state.step)
    recorded = image.camera.refined(pose.detach())
    posed = state.scene.posed_in_fit(recorded, image.timestamp_ns, pose)
    looks = {row: posed.looks()}
    if guidance is not None:
        place, painted = guidance
        beside = state.scene.posed_in_fit(painted.camera, painted.timestamp_ns)
        looks[~place] = beside.looks()
    seen = state.seen(looks)
    probes = [state.hidden.probe(name, len(seen)) for name in looks]
    of_recorded = partial(
        _recorded_gradients, state, seen, image, row, posed, config, perceptual, probes[0]
    )
    if guidance is None:
        found = of_recorded()
    else:
        twin = seen.twin()
        of_painted = partial(
            add_guidance_gradients, state, twin, painted, beside, config, perceptual, probes[1]
        )
        found, _ = both(of_recorded, of_painted, state.scene.device)
        seen.take_gradients_of(twin)
    for name, probe in zip(looks, probes, strict=True):
        state.hidden.learn(name, seen.rows, probe)
    state.tally.add(seen.rows, found.screen_gradient, found.splat.visible)
    state.refinement.step(state.step, image)
    _step_sky(state, found, config, image)
    state.step_gaussians(seen, state.step / config.steps)
    return found.told


class _OfRecorded(NamedTuple):
    """What a recorded view leaves beside the gradients of Gaussians, poses and exposure."""

    told: Float[Tensor, "2"]
    splat: SplatImage
    screen_gradient: Float[Tensor, " seen"]
    sky_rgb: Float[Tensor, "height width 3"]
    sky_rays: SkyRays


def _recorded_gradients(  # noqa: PLR0913 - what a step is made of
    state: FitState,
    seen: SeenGaussians,
    image: FitImage,
    row: int,
    posed: PosedScene,
    config: FitConfig,
    perceptual: Perceptual | None,
    probe: Float[Tensor, "seen 1"] | None,
) -> _OfRecorded:
    """Collect the gradients of a recorded view."""
    weights, sky = config.losses, state.scene.sky
    facts = image.facts()
    with_actors = _wants_actor_term(state, config)
    screen_gradient = torch.zeros(len(seen), device=seen.means.device)
    splat = posed.draw(
        seen,
        with_actor_alpha=with_actors,
        channel=probe,
        screen_gradient_out=screen_gradient,
    )
    rays = sky.rays(posed.camera, (splat.alpha.detach() < OPAQUE) | image.is_open)
    sky_rgb = sky.sample(rays).requires_grad_(True)
    exposure = state.refinement.exposure(image)
    terms = pixel_terms(splat, sky_rgb, facts, _pixel_rules(config), exposure=exposure)
    shown = terms.shown
    if image.hidden is not None:
        shown = torch.where(image.hidden[..., None], facts.rgb, shown)
    loss = l1_ssim_loss(shown, facts.rgb, ssim_weight=weights.ssim)
    if perceptual is not None and weights.perceptual > 0:
        loss = loss + weights.perceptual * perceptual(shown, facts.rgb)
    loss = loss + weights.sky * terms.sky + weights.depth * terms.depth
    if with_actors:
        loss = loss + weights.actors * _actor_term(splat, posed)
    loss = loss + state.refinement.bend_prior(image.timestamp_ns, state.step)
    prior = state.refinement.prior(row, image.timestamp_ns, state.step)
    # as a sum its gradient, which is the CPU's, would have to come from the device
    total = loss if probe is None else loss + probed(splat)
    torch.autograd.backward([total, prior] if prior.requires_grad else [total])
    squared_error = (shown.detach() - facts.rgb).square().mean()
    told = torch.stack([loss.detach() + prior.detach(), squared_error.double()])
    return _OfRecorded(told, splat, screen_gradient, sky_rgb, rays)


def add_guidance_gradients(
    state: FitState,
    seen: SeenGaussians,
    view: GuidanceView,
    posed: PosedScene,
    config: FitConfig,
    perceptual: Perceptual | None = None,
    probe: Float[Tensor, "seen 1"] | None = None,
) -> None:
    """Add one painted view's gradients to the Gaussians; nothing else is changed by it.

    What LiDAR hit is opaque there as on recorded views. The depth term alone is content with ever
    less of what is there, and wears away what recorded views do not hold.
    """
    sky, settings = state.scene.sky, config.guidance
    splat = posed.held().draw(seen, channel=probe)
    sky_rgb = sky.sample(sky.rays(view.camera, splat.alpha.detach() < OPAQUE))
    shown = splat.rgb + (1 - splat.alpha)[..., None] * sky_rgb
    loss = settings.weight * l1_ssim_loss(
        shown, view.rgb, ssim_weight=settings.ssim, pixel_weight=view.weight
    )
    if perceptual is not None and settings.perceptual > 0:
        trusted = torch.where(view.weight[..., None] > 0, shown, view.rgb)
        distance = view.weight.mean() * perceptual(trusted, view.rgb)
        loss = loss + settings.weight * settings.perceptual * distance
    if settings.depth > 0:
        loss = loss + settings.depth * depth_loss(
            splat.depth_m, splat.alpha, view.lidar_depth_m, tolerance=config.losses.depth_tolerance
        )
    is_hit = view.lidar_depth_m > 0
    loss = loss + config.losses.sky * clear_sky_loss(splat.alpha, torch.zeros_like(is_hit), is_hit)
    if probe is not None:
        loss = loss + probed(splat)
    loss.backward()


def actor_boundary_loss(
    actor_alpha: Float[Tensor, "height width"], in_boxes: Bool[Tensor, "height width"]
) -> Float[Tensor, ""]:
    """Mean of -log(1 - actor_alpha) outside the projected boxes, of its entropy inside."""
    inside = actor_alpha.clamp(_EDGE, 1 - _EDGE)
    log_clear = torch.log1p(-inside)
    entropy = -(inside * inside.log() + (1 - inside) * log_clear)
    return torch.where(in_boxes, entropy, -log_clear).mean()


def _pixel_rules(config: FitConfig) -> PixelRules:
    return PixelRules(
        sky_tolerance=config.losses.sky_tolerance,
        depth_tolerance=config.losses.depth_tolerance,
        min_transmittance=MIN_TRANSMITTANCE,
    )


def _wants_actor_term(state: FitState, config: FitConfig) -> bool:
    is_due = state.step % ACTOR_TERM_EVERY == 0
    return is_due and config.losses.actors > 0 and bool(state.scene.actors.recorded_tracks)


def _actor_term(splat: SplatImage, posed: PosedScene) -> Float[Tensor, ""]:
    """Actors stay inside their projected boxes."""
    world_from_actors, present = posed.poses
    sizes = [track.size_m for track in posed.actors.recorded_tracks]
    in_boxes = project_boxes(posed.camera, world_from_actors.detach(), sizes, present > 0)
    in_boxes = in_boxes.to(splat.alpha.device, non_blocking=True)
    return actor_boundary_loss(splat.features[..., 0], in_boxes)


def _step_sky(state: FitState, found: _OfRecorded, config: FitConfig, image: FitImage) -> None:
    """Move the texels that were seen clearly enough, inside the sky mask alone.

    What is far but solid (towers beyond the LiDAR's reach) is left to the Gaussians.
    """
    if found.sky_rgb.grad is None:
        return
    clear = 1 - found.splat.alpha.detach()
    learns = (clear > MIN_TRANSMITTANCE) & (image.kind == SKY)
    ratio = FINAL_LEARNING_RATE / LEARNING_RATE
    state.scene.sky.observe(
        found.sky_rgb.grad,
        torch.where(learns, clear, 0.0),
        found.sky_rays,
        LEARNING_RATE * ratio ** (state.step / config.steps),
    )
