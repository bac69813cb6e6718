"""Fit a dynamic Gaussian scene to its observations, and go on fitting it with painted views.

Each step draws one recorded view, compares it with its image (L1 + 0.2 (1 - SSIM), optionally a
perceptual distance) and LiDAR depth, and moves Gaussians, sky and pose corrections; some steps add
a painted view. Equal inputs give bitwise equal scenes, interrupted or not.
"""

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from statistics import fmean

import torch

from lidarpainter_models.devices import return_freed_memory, within_memory
from lidarpainter_models.errors import ConfigError
from lidarpainter_models.gaussians.fitting.checkpoint import CheckpointFolder
from lidarpainter_models.gaussians.fitting.config import FitConfig
from lidarpainter_models.gaussians.fitting.densification import densify, prune
from lidarpainter_models.gaussians.fitting.images import FitImage, fit_images
from lidarpainter_models.gaussians.fitting.lamp_search import with_lamps_found
from lidarpainter_models.gaussians.fitting.memory import planned_memory, within_limit
from lidarpainter_models.gaussians.fitting.seen_surface import (
    SeenSurface,
    planned_fit,
    seen_surface,
    with_shown_beside,
)
from lidarpainter_models.gaussians.fitting.shape_limits import (
    LIMITS_EVERY,
    limit_shapes,
    viewing_rays,
)
from lidarpainter_models.gaussians.fitting.state import FitState
from lidarpainter_models.gaussians.fitting.step import Perceptual, fit_step
from lidarpainter_models.gaussians.initialisation.scene import initialise_scene
from lidarpainter_models.gaussians.model.gaussian_scene import GaussianScene
from lidarpainter_models.gaussians.model.sky import sky_layout
from lidarpainter_models.gaussians.model.stored_scene import copy_scene
from lidarpainter_models.observations.views import GuidanceView, SceneObservations

FIRST_LOOK = 0.1
"""Part of the steps after which the scene is shown for the first time."""
LAMPS_AT = 0.6
"""Part of the steps after which lamps are looked for: Gaussians are split, colours have settled."""
LAMP_STEPS = 0.1
"""Images that are looked through for lamps, as a part of the steps."""
FirstLook = Callable[[GaussianScene], None]
Progress = Callable[[int, int, dict[str, float]], None]
"""Told the steps done, the steps in all and the newest entry of the history; before the first step
`initialised`, the part of the first scene that is made, then `planned_bytes` (see `memory`),
`num_views`, `surface_pixels` and `most_gaussians`."""


@dataclass(frozen=True, kw_only=True, eq=False)
class FitResult:
    """A fitted scene and how it came about."""

    scene: GaussianScene
    history: list[dict[str, float]]
    """Every so many steps: step, loss, psnr (training views), num_gaussians, cpu_s."""
    stopped_early: bool
    """Whether a limit of time left it fewer steps than planned."""


@dataclass(frozen=True)
class Told:
    """Who hears of a running fit."""

    progress: Progress | None
    first_look: FirstLook | None


class _Clock:
    """How many steps the time has room for, by how long those of this process took."""

    def __init__(self, step: int) -> None:
        self._first, self._began_s = step, time.monotonic()

    def in_time(self, step: int, config: FitConfig) -> FitConfig:
        """The config, with fewer steps where the time allowed ends before them."""
        if config.time_limit_s is None or step <= self._first:
            return config
        gone_s = time.monotonic() - self._began_s
        done = config.work(step) - config.work(self._first)
        rest = (config.time_limit_s - gone_s) * done / gone_s
        return replace(config, steps=config.steps_within(rest, step))


def fit_gaussians(  # noqa: PLR0913 - what was recorded, and one option each
    observations: SceneObservations,
    config: FitConfig,
    *,
    start: GaussianScene | None = None,
    guidance: Sequence[GuidanceView] = (),
    checkpoints: CheckpointFolder | None = None,
    progress: Progress | None = None,
    first_look: FirstLook | None = None,
    perceptual: Perceptual | None = None,
    device: torch.device | None = None,
) -> FitResult:
    """Fit a scene.

    Args:
        observations: what was recorded.
        config: see there.
        start: the scene to go on from; without it one is made from the LiDAR map.
        guidance: painted views.
        checkpoints: where to keep the running fit; an existing checkpoint is taken up.
        progress: told about every entry of the history.
        first_look: shown the scene after the first tenth of the steps.
        perceptual: distance of a rendered and a true image, such as LPIPS, weighted by
            `losses.perceptual` on recorded views and `guidance.perceptual` on painted ones.
        device: where the fit runs and the scene then lies; None is where the start lies. Where its
            memory runs out, images are left on the CPU: the same fit, a little slower.

    Raises:
        ConfigError: the start belongs to other training views, a weight lacks its function, or
            the memory allowed holds no fit.
        DeviceMemoryError: it does not fit into the device's memory.
    """
    _check(observations, config, start, perceptual)
    device = device or (start.device if start is not None else torch.device("cpu"))
    street = observations.lidar_map.street.xyz_m if observations.is_estimated else None
    surface = seen_surface(observations.views, street)
    pixels = fmean(view.camera.width_px * view.camera.height_px for view in observations.views)
    config = planned_fit(config, with_shown_beside(surface, observations.views, guidance))
    looks = config.steps / max(surface.whole_views, 1.0)
    config = replace(config, learning_rates=config.learning_rates.over(looks))
    if device.type == "cpu":
        config = within_limit(
            observations,
            config,
            sky_layout([view.camera for view in observations.views]),
            start=None if start is None else start.gaussians,
            guidance=guidance,
        )
    told = Told(progress, first_look)
    steps = partial(_steps, observations, surface, config, guidance, checkpoints, told, perceptual)

    def attempt(spares: bool) -> FitResult:
        kept = checkpoints.load() if checkpoints is not None else None
        if kept is not None:
            return steps(FitState.resume(*kept, config, pixels, device), keeps_images=not spares)
        first = start or _first_scene(observations, config, progress)
        return steps(FitState.begin(first.to(device), config, pixels), keeps_images=not spares)

    what = "the fit: a lower densification.budget or a narrower observation.width_px takes less"
    return within_memory(attempt, device, what)


def _steps(  # noqa: PLR0913 - as `fit_gaussians`
    observations: SceneObservations,
    surface: SeenSurface,
    config: FitConfig,
    guidance: Sequence[GuidanceView],
    checkpoints: CheckpointFolder | None,
    told: Told,
    perceptual: Perceptual | None,
    state: FitState,
    *,
    keeps_images: bool,
) -> FitResult:
    """All steps that are left; images lie where the scene does, or are sent there one by one."""
    cpu_before_s = time.process_time() - state.cpu_s
    if told.progress is not None:
        plan = planned_memory(
            observations,
            config,
            state.scene.sky.layout,
            start=state.scene.gaussians,
            guidance=guidance,
            keeps_images=keeps_images,
        )
        on_cpu = state.scene.device.type == "cpu"
        sizes = {
            "planned_bytes": float(plan.of_process if on_cpu else plan.total),
            "num_views": float(len(observations.views)),
            "surface_pixels": surface.num_pixels,
            "most_gaussians": float(config.densification.budget),
        }
        told.progress(state.step, config.steps, sizes)
    half_too = config.half_resolution > 0
    full, half = fit_images(observations.views, state.scene.sky.layout, half_too=half_too)
    if keeps_images:
        device = state.scene.device
        full, half = ([image.to(device) for image in images] for images in (full, half))
        guidance = [view.to(device) for view in guidance]
    clock, look, planned_steps = _Clock(state.step), told.first_look, config.steps
    while state.step < config.steps:
        is_half = state.step < config.half_resolution * config.steps
        row = state.next_view(surface.groups)
        _advance(state, half if is_half else full, row, guidance, config, perceptual)
        state.cpu_s = time.process_time() - cpu_before_s
        if state.step % config.log_every == 0 or state.step == config.steps:
            config = state.refinement.config = clock.in_time(state.step, config)
            _log(state, config, told.progress)
        if look is not None and state.step >= config.steps * FIRST_LOOK:
            look(state.caught_up())
            look = None
        if checkpoints is not None and checkpoints.is_due(state.step):
            checkpoints.save(*state.keep())
    return FitResult(
        scene=_finished(state),
        history=state.history,
        stopped_early=config.steps < planned_steps,
    )


def _first_scene(
    observations: SceneObservations, config: FitConfig, progress: Progress | None
) -> GaussianScene:
    def told(share: float) -> None:
        if progress is not None:
            progress(0, config.steps, {"initialised": share})

    return_freed_memory()  # of what prepared the observations
    return initialise_scene(observations, config.initialisation, progress=told)


def _advance(
    state: FitState,
    images: Sequence[FitImage],
    row: int,
    guidance: Sequence[GuidanceView],
    config: FitConfig,
    perceptual: Perceptual | None,
) -> None:
    """One step: gradients, optimisers, and at their times the rounds that change the set."""
    painted = None
    takes_part = state.step < config.guidance.until * config.steps
    if guidance and takes_part and state.random() < config.guidance.probability:
        place = int(torch.randint(len(guidance), (), generator=state.generator))
        painted = (place, guidance[place].to(state.scene.device))
    image = images[row].to(state.scene.device)
    told = fit_step(state, image, row, painted, config, perceptual)
    state.step += 1
    state.recent.append(told)
    _change_set(state, config)
    if config.refinement.lamps and not state.sought_lamps and not len(state.scene.blinking):
        _seek_lamps(state, images, config)
    if state.step % LIMITS_EVERY == 0:
        scene = state.caught_up()
        limit_shapes(scene.gaussians, viewing_rays(scene), config.shapes)
        state.blocks.refresh(scene.gaussians)


def _change_set(state: FitState, config: FitConfig) -> None:
    """Split and prune when it is time."""
    settings, fraction = config.densification, state.step / config.steps
    if state.step % settings.every or fraction < settings.start or state.step == config.steps:
        return
    sizes = [track.size_m for track in state.scene.actors.recorded_tracks]
    gaussians = state.caught_up().gaussians
    if fraction > settings.stop:
        state.apply(prune(gaussians, sizes))
        return
    state.apply(
        densify(
            gaussians,
            state.tally,
            sizes,
            target=_target(len(gaussians), fraction, config),
            threshold=settings.threshold,
        )
    )


def _seek_lamps(state: FitState, images: Sequence[FitImage], config: FitConfig) -> None:
    """Look for lamps that go on and off when it is time."""
    if state.step < LAMPS_AT * config.steps:
        return
    cameras = [
        image.camera.refined(state.refinement.world_from_camera(row, state.step).detach())
        for row, image in enumerate(images)
    ]
    most = math.ceil(LAMP_STEPS * config.steps)
    state.take_lamps(with_lamps_found(state.caught_up(), images, cameras, most))


def _target(num_gaussians: int, fraction: float, config: FitConfig) -> int:
    """How many Gaussians there may be after a round: even steps up to the budget, or all of it."""
    settings = config.densification
    if settings.threshold > 0:
        return settings.budget
    first = min(num_gaussians, settings.budget)
    progress = (fraction - settings.start) / max(settings.stop - settings.start, 1e-9)
    rounds_left = max((1 - progress) * (settings.stop - settings.start), 0) * config.steps
    rounds_left = 1 + rounds_left // settings.every
    return first + math.ceil((settings.budget - first) / rounds_left)


def _log(state: FitState, config: FitConfig, progress: Progress | None) -> None:
    """Add an entry to the history."""
    losses, errors = zip(*(state.recent_numbers() or [[0.0, 1.0]]), strict=True)
    entry = {
        "step": float(state.step),
        "loss": sum(losses) / len(losses),
        "psnr": sum(-10 * math.log10(max(error, 1e-10)) for error in errors) / len(errors),
        "num_gaussians": float(state.scene.num_gaussians),
        "cpu_s": state.cpu_s,
    }
    state.recent = []
    state.history.append(entry)
    if progress is not None:
        progress(state.step, config.steps, entry)


def _finished(state: FitState) -> GaussianScene:
    """The scene without gradients, useless Gaussians or unseen sky."""
    scene = copy_scene(state.caught_up())
    sizes = [track.size_m for track in scene.actors.recorded_tracks]
    change = prune(scene.gaussians, sizes)
    return replace(scene, gaussians=change.gaussians, sky=scene.sky.filled())


def _check(
    observations: SceneObservations,
    config: FitConfig,
    start: GaussianScene | None,
    perceptual: Perceptual | None,
) -> None:
    keys = tuple(view.key for view in observations.views)
    if start is not None and start.cameras.keys != keys:
        raise ConfigError(
            f"the start was fitted to {len(start.cameras.keys)} other training views than the "
            f"{len(keys)} given"
        )
    if perceptual is None and config.weighs_perceptual:
        raise ConfigError(
            "losses.perceptual or guidance.perceptual is positive, but no perceptual distance is "
            "given"
        )
