"""One step of a fit: gradients of a recorded view and perhaps a painted one, and the optimisers.

Only the Gaussians that these views can show take part (`seen_gaussians`).
"""

from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor

from lidarpainter_models.gaussians.fitting.config import FitConfig
from lidarpainter_models.gaussians.fitting.images import FitImage
from lidarpainter_models.gaussians.fitting.losses import (
    actor_boundary_loss,
    pose_prior,
)
from lidarpainter_models.gaussians.fitting.pixel_terms import SKY, depth_loss, pixel_terms
from lidarpainter_models.gaussians.fitting.spatial_blocks import View
from lidarpainter_models.gaussians.fitting.state import FitState
from lidarpainter_models.gaussians.model.scene_graph import OPAQUE
from lidarpainter_models.gaussians.model.seen_gaussians import SeenGaussians
from lidarpainter_models.gaussians.model.sky_sampling import SkyRays
from lidarpainter_models.geometry.box_masks import project_boxes
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.kernels.gaussian_raster import SplatImage
from lidarpainter_models.kernels.ssim import l1_ssim_loss
from lidarpainter_models.observations.views import GuidanceView

Perceptual = Callable[
    [Float[Tensor, "height width 3"], Float[Tensor, "height width 3"]], Float[Tensor, ""]
]
"""Distance of a rendered and a true image, differentiable in the first."""


def fit_step(
    state: FitState,
    image: FitImage,
    row: int,
    guidance: GuidanceView | None,
    config: FitConfig,
    perceptual: Perceptual | None,
) -> tuple[float, float]:
    """Step everything by one recorded view, the `row`-th, and the painted one if it is given.

    Returns the loss and the mean squared error of the recorded image.
    """
    scene, refinement = state.scene, config.refinement
    pose = scene.cameras.world_from_camera(row)
    if not (refinement.cameras and state.step >= refinement.start_step):
        pose = pose.detach()
    recorded = image.camera.at(pose.detach())
    bodies = scene.camera_from_body(pose, *scene.world_from_actors(image.timestamp_ns))
    views = [(recorded, bodies)]
    if guidance is not None:
        views.append((guidance.camera, _guidance_bodies(state, guidance)))
    seen = state.seen(views)
    told = _recorded_step(state, seen, image, row, views[0], config, perceptual)
    if guidance is not None:
        add_guidance_gradients(state, seen, guidance, config)
    state.step_gaussians(seen, state.step / config.steps)
    return told


def _recorded_step(
    state: FitState,
    seen: SeenGaussians,
    image: FitImage,
    row: int,
    view: View,
    config: FitConfig,
    perceptual: Perceptual | None,
) -> tuple[float, float]:
    """Collect the Gaussians' gradients from a recorded view; step poses, exposure and sky."""
    scene, (camera, bodies) = state.scene, view
    with_actors = _wants_actor_term(state, config)
    screen_gradient = torch.zeros(len(seen))
    splat = scene.splat(
        camera,
        bodies,
        gaussians=seen,
        with_actor_alpha=with_actors,
        screen_gradient_out=screen_gradient,
    )
    rays = scene.sky.rays(camera, (splat.alpha.detach() < OPAQUE) | image.is_open)
    sky_rgb = scene.sky.sample(rays).requires_grad_(True)
    terms = pixel_terms(
        splat,
        sky_rgb,
        image.facts,
        sky_tolerance=config.losses.sky_tolerance,
        depth_tolerance=config.losses.depth_tolerance,
        least_clear=config.initialisation.sky.min_transmittance,
    )
    shown = terms.shown
    if _fits_exposure(state, config):
        shown = scene.exposure.apply(shown, image.camera_name)
    loss = _image_loss(shown, image, config, perceptual)
    loss = loss + config.losses.sky * terms.sky + config.losses.depth * terms.depth
    if with_actors:
        loss = loss + config.losses.actors * _actor_term(state, splat, image, camera)
    loss = loss + _priors(state, scene.cameras.tangent(row), image.timestamp_ns, config)
    loss.backward()
    state.tally.add(seen.rows, screen_gradient, splat.visible)
    _step_poses(state, config)
    _step_sky(state, sky_rgb, rays, splat.alpha.detach(), config, image)
    squared_error = (shown.detach() - image.facts.rgb).square().mean()
    return float(loss.detach()), float(squared_error)


def _guidance_bodies(state: FitState, view: GuidanceView) -> Float[Tensor, "bodies 4 4"]:
    """Where a painted view has the bodies; no gradient."""
    with torch.no_grad():
        actors = state.scene.world_from_actors(view.timestamp_ns)
        return state.scene.camera_from_body(view.camera.world_from_camera, *actors)


def add_guidance_gradients(
    state: FitState,
    seen: SeenGaussians,
    view: GuidanceView,
    config: FitConfig,
) -> None:
    """Add one painted view's gradients to the Gaussians; nothing else is changed by it.

    With the freedom `appearance` only colour and opacity receive any.
    """
    scene, settings = state.scene, config.guidance
    if settings.freedom == "appearance":
        seen = seen.with_fixed_geometry()
    splat = scene.splat(view.camera, _guidance_bodies(state, view), gaussians=seen)
    sky_rgb = scene.sky.sample(scene.sky.rays(view.camera, splat.alpha.detach() < OPAQUE))
    shown = splat.rgb + (1 - splat.alpha)[..., None] * sky_rgb
    loss = settings.weight * l1_ssim_loss(
        shown, view.rgb, ssim_weight=settings.ssim, pixel_weight=view.weight
    )
    if settings.depth > 0 and settings.freedom == "all":
        loss = loss + settings.depth * depth_loss(
            splat.depth_m, splat.alpha, view.lidar_depth_m, tolerance=config.losses.depth_tolerance
        )
    loss.backward()


def _image_loss(
    shown: Float[Tensor, "height width 3"],
    image: FitImage,
    config: FitConfig,
    perceptual: Perceptual | None,
) -> Float[Tensor, ""]:
    target = image.facts.rgb
    loss = l1_ssim_loss(shown, target, ssim_weight=config.losses.ssim)
    if perceptual is not None and config.losses.perceptual > 0:
        loss = loss + config.losses.perceptual * perceptual(shown, target)
    return loss


def _actor_term(
    state: FitState, splat: SplatImage, image: FitImage, camera: Camera
) -> Float[Tensor, ""]:
    """Actors stay inside their projected boxes."""
    with torch.no_grad():
        world_from_actors, present = state.scene.world_from_actors(image.timestamp_ns)
        sizes = [track.size_m for track in state.scene.recorded_tracks]
        in_boxes = project_boxes(camera, world_from_actors, sizes, present > 0)
    return actor_boundary_loss(splat.features[..., 0], in_boxes)


def _priors(
    state: FitState, tangent: Float[Tensor, "6"], timestamp_ns: int, config: FitConfig
) -> Float[Tensor, ""]:
    """Corrections are small, and an actor's change little from one knot to the next."""
    scene, refinement, weights = state.scene, config.refinement, config.losses
    total = tangent.new_zeros(())
    if state.step < refinement.start_step:
        return total
    if refinement.cameras:
        total = total + weights.pose_prior * pose_prior(
            tangent[None],
            rotation_rad=refinement.camera_noise_rad,
            translation_m=refinement.camera_noise_m,
        )
    if refinement.actors and scene.recorded_tracks:
        noise = {
            "rotation_rad": refinement.actor_noise_rad,
            "translation_m": refinement.actor_noise_m,
        }
        now = scene.actors.at(timestamp_ns)
        total = total + weights.actor_prior * pose_prior(now, **noise)
        before, after, _ = scene.actors.neighbours(timestamp_ns)
        last = scene.actors.knots_ns.numel() - 1
        for neighbour in {max(before - 1, 0), min(after + 1, last)}:
            step = now - scene.actors.tangent[:, neighbour].detach()
            total = total + weights.actor_smoothness * pose_prior(step, **noise)
    return total


def _step_poses(state: FitState, config: FitConfig) -> None:
    """Step the corrections that received gradients, and drop these."""
    scene, rates, refinement = state.scene, config.learning_rates, config.refinement
    fraction, is_refined = state.step / config.steps, state.step >= refinement.start_step
    if refinement.cameras and is_refined:
        rate = _tangent_rate(
            rates.at("camera_rotation_rad", fraction), rates.at("camera_translation_m", fraction)
        )
        table = scene.cameras.view_tangent
        state.camera_adam.step(table, _gradient(table), rate)
        scene.cameras.recentre(keep_mean=refinement.extrinsics)
    if refinement.actors and is_refined and scene.recorded_tracks:
        rate = _tangent_rate(
            rates.at("actor_rotation_rad", fraction), rates.at("actor_translation_m", fraction)
        )
        with torch.no_grad():
            table = scene.actors.tangent.view(-1, 6)
            state.actor_adam.step(table, _gradient(scene.actors.tangent).view(-1, 6), rate)
    if _fits_exposure(state, config):
        with torch.no_grad():
            rate = torch.full((12,), rates.at("exposure", fraction))
            gradient = _gradient(scene.exposure.matrix).flatten(1)
            if len(scene.exposure.camera_names) > 1:
                gradient[0] = 0  # the reference: all cameras together would be free to drift
            state.exposure_adam.step(scene.exposure.matrix.view(-1, 12), gradient, rate)
    for table in (scene.cameras.view_tangent, scene.actors.tangent, scene.exposure.matrix):
        table.grad = None


def _wants_actor_term(state: FitState, config: FitConfig) -> bool:
    weights = config.losses
    is_due = state.step % weights.actors_every == 0
    return is_due and weights.actors > 0 and bool(state.scene.recorded_tracks)


def _gradient(table: Tensor) -> Tensor:
    """What the backward pass left.

    Raises:
        RuntimeError: it never reached this table.
    """
    if table.grad is None:
        raise RuntimeError(f"no gradient reached a table of shape {tuple(table.shape)}")
    return table.grad


def _fits_exposure(state: FitState, config: FitConfig) -> bool:
    """One camera alone has no other to differ from."""
    return config.refinement.exposure or len(state.scene.exposure.camera_names) > 1


def _tangent_rate(rotation_rad: float, translation_m: float) -> Float[Tensor, "6"]:
    return torch.tensor([rotation_rad] * 3 + [translation_m] * 3, dtype=torch.float64)


def _step_sky(
    state: FitState,
    sky_rgb: Float[Tensor, "height width 3"],
    rays: SkyRays,
    alpha: Float[Tensor, "height width"],
    config: FitConfig,
    image: FitImage,
) -> None:
    """Move the texels that were seen clearly enough."""
    settings = config.initialisation.sky
    if sky_rgb.grad is None:
        return
    clear = 1 - alpha
    learns = clear > settings.min_transmittance
    if config.sky_in_mask_only:
        learns &= image.facts.kind == SKY
    ratio = settings.final_learning_rate / settings.learning_rate
    state.scene.sky.observe(
        sky_rgb.grad,
        torch.where(learns, clear, torch.zeros_like(clear)),
        rays,
        settings.learning_rate * ratio ** (state.step / config.steps),
    )
