"""One step of a fit: gradients of a recorded view and perhaps a painted one, and the optimisers.

Only the Gaussians that these views can show take part (`seen_gaussians`). Gaussians, sky and images
lie on the device of the scene; poses (float64) and exposure, a few small matrices a step, on the
CPU.
"""

from functools import partial
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from lidarpainter_models.gaussians.fitting.images import FitImage
from lidarpainter_models.gaussians.fitting.loss import (
    ACTOR_TERM_EVERY,
    actor_loss,
    painted_loss,
    recorded_loss,
)
from lidarpainter_models.gaussians.fitting.occlusion_culling import probed
from lidarpainter_models.gaussians.fitting.state import FitState
from lidarpainter_models.gaussians.model.drawing import OPAQUE
from lidarpainter_models.gaussians.model.scene_rendering import PosedScene
from lidarpainter_models.gaussians.model.seen_gaussians import SeenGaussians
from lidarpainter_models.gaussians.model.sky import (
    FINAL_LEARNING_RATE,
    LEARNING_RATE,
    MIN_TRANSMITTANCE,
)
from lidarpainter_models.kernels.gaussian_raster import SplatImage
from lidarpainter_models.kernels.pixel_losses import OPEN, SKY
from lidarpainter_models.kernels.side_by_side import both
from lidarpainter_models.kernels.sky_texture import SkyRays
from lidarpainter_models.observations.views import GuidanceView

WAITS = 4
"""The most of the host for the device in a step, without the rasteriser's own: how many Gaussians
are in view, how many of them lag and by how much (plain torch alone asks), and the gradients of the
bodies' poses and of the exposure. Where somebody bends, one more for each view: which Gaussians
do; where lamps blink, two more for each: which are in one; for each that looks at everything, one:
which of it shows nothing."""


def fit_step(
    state: FitState, image: FitImage, row: int, guidance: tuple[int, GuidanceView] | None = None
) -> Float[Tensor, "2"]:
    """Step everything by one recorded view and a painted one, if given; each at its place.

    Returns:
        The loss and the mean squared error of the recorded image, where the scene lies.
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
    of_recorded = partial(_recorded_gradients, state, seen, image, row, posed, probes[0])
    if guidance is None:
        found = of_recorded()
    else:
        twin = seen.twin()
        of_painted = partial(add_guidance_gradients, state, twin, painted, beside, probes[1])
        found, _ = both(of_recorded, of_painted, state.scene.device)
        seen.take_gradients_of(twin)
    for name, probe in zip(looks, probes, strict=True):
        state.hidden.learn(name, seen.rows, probe)
    state.tally.add(seen.rows, found.screen_gradient, found.splat.visible)
    state.refinement.step(state.step, state.fraction, image)
    _step_sky(state, found, image)
    state.step_gaussians(seen)
    return found.told


class _OfRecorded(NamedTuple):
    """What a recorded view leaves beside the gradients of Gaussians, poses and exposure."""

    told: Float[Tensor, "2"]
    splat: SplatImage
    screen_gradient: Float[Tensor, " seen"]
    sky_rgb: Float[Tensor, "height width 3"]
    sky_rays: SkyRays


def _recorded_gradients(
    state: FitState,
    seen: SeenGaussians,
    image: FitImage,
    row: int,
    posed: PosedScene,
    probe: Float[Tensor, "seen 1"] | None,
) -> _OfRecorded:
    weights, sky = state.config.losses, state.scene.sky
    facts = image.facts()
    with_actors = _wants_actor_term(state)
    screen_gradient = torch.zeros(len(seen), device=seen.means.device)
    splat = posed.draw(
        seen, with_actor_alpha=with_actors, channel=probe, screen_gradient_out=screen_gradient
    )
    rays = sky.rays(posed.camera, (splat.alpha.detach() < OPAQUE) | (image.kind == OPEN))
    sky_rgb = sky.sample(rays).requires_grad_(True)
    exposure = state.refinement.exposure(image)
    loss, shown = recorded_loss(
        splat, sky_rgb, image, facts, weights, exposure=exposure, perceptual=state.perceptual
    )
    if with_actors:
        loss = loss + weights.actors * actor_loss(splat, posed)
    loss = loss + state.refinement.bend_prior(image.timestamp_ns, state.step)
    loss = loss + state.refinement.light_prior(image.timestamp_ns)
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
    probe: Float[Tensor, "seen 1"] | None = None,
) -> None:
    """Add one painted view's gradients to the Gaussians; nothing else is changed by it."""
    sky = state.scene.sky
    splat = posed.held().draw(seen, channel=probe)
    sky_rgb = sky.sample(sky.rays(view.camera, splat.alpha.detach() < OPAQUE))
    loss = painted_loss(splat, sky_rgb, view, state.config, state.perceptual)
    if probe is not None:
        loss = loss + probed(splat)
    loss.backward()


def _wants_actor_term(state: FitState) -> bool:
    is_due = state.step % ACTOR_TERM_EVERY == 0
    return is_due and state.config.losses.actors > 0 and bool(state.scene.actors.recorded_tracks)


def _step_sky(state: FitState, found: _OfRecorded, image: FitImage) -> None:
    """Move the texels that were seen clearly enough, inside the sky mask alone."""
    if found.sky_rgb.grad is None:
        return
    clear = 1 - found.splat.alpha.detach()
    learns = (clear > MIN_TRANSMITTANCE) & (image.kind == SKY)
    ratio = FINAL_LEARNING_RATE / LEARNING_RATE
    state.scene.sky.observe(
        found.sky_rgb.grad,
        torch.where(learns, clear, 0.0),
        found.sky_rays,
        LEARNING_RATE * ratio**state.fraction,
    )
