"""The loop of a fit: from what was recorded, and perhaps painted, to a dynamic Gaussian scene.

Each step draws one recorded view, compares it with its image and LiDAR depth (`loss`), and moves
Gaussians, sky and pose corrections; some steps add a painted view. How many steps and Gaussians
there are is planned before the first (`plan`). Equal inputs give bitwise equal scenes, interrupted
or not (`checkpoint`).
"""

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Protocol, runtime_checkable

import torch

from lidarpainter_models.devices import return_freed_memory, within_memory
from lidarpainter_models.errors import ConfigError
from lidarpainter_models.gaussians.fitting.checkpoint import CheckpointFolder
from lidarpainter_models.gaussians.fitting.config import FitConfig
from lidarpainter_models.gaussians.fitting.densification import densify, prune
from lidarpainter_models.gaussians.fitting.images import FitImage, fit_images
from lidarpainter_models.gaussians.fitting.lamp_search import with_lamps_found
from lidarpainter_models.gaussians.fitting.loss import Perceptual
from lidarpainter_models.gaussians.fitting.plan import FitPlan, plan_fit
from lidarpainter_models.gaussians.fitting.shape_limits import (
    LIMITS_EVERY,
    limit_shapes,
    viewing_rays,
)
from lidarpainter_models.gaussians.fitting.state import FitState
from lidarpainter_models.gaussians.fitting.step import fit_step
from lidarpainter_models.gaussians.initialisation.scene import initialise_scene
from lidarpainter_models.gaussians.model.gaussian_scene import GaussianScene
from lidarpainter_models.gaussians.model.stored_scene import copy_scene
from lidarpainter_models.observations.views import GuidanceView, SceneObservations

HALF_STEP = 0.6
"""What a step at half the image size costs of one at full size: 0.46 in images 960 pixels wide, in
smaller ones 0.72, as Gaussians cost more than pixels there (docs/decisions/length-of-a-fit.md)."""


def work_of(step: int, config: FitConfig, steps: int | None = None) -> float:
    """Return what the first `step` steps of so many in all cost, in steps at full image size."""
    steps = config.steps if steps is None else steps
    return step - (1 - HALF_STEP) * min(step, config.half_resolution * steps)


def steps_within(work: float, step: int, config: FitConfig) -> int:
    """Return how many steps there may be in all, so that those after `step` cost so much `work`.

    The planned steps are the most; of fewer steps, the part at half size is shorter too.
    """
    half = config.half_resolution
    steps = (work + HALF_STEP * step) / (HALF_STEP * half + 1 - half)
    if steps * half < step:
        steps = step + max(work, 0.0)
    return min(config.steps, int(steps))


class FitClock:
    """How many steps the time has room for, by how long those of this process took."""

    def __init__(self, step: int, config: FitConfig) -> None:
        """Start before the given step; a fit that is taken up again has its time once more."""
        self._first, self._config, self._began_s = step, config, time.monotonic()

    def steps_in_time(self, step: int, steps: int) -> int:
        """Return how many steps the fit has in all, of `steps` so far, after `step` of them."""
        limit_s = self._config.time_limit_s
        if limit_s is None or step <= self._first:
            return steps
        gone_s = time.monotonic() - self._began_s
        done = work_of(step, self._config, steps) - work_of(self._first, self._config, steps)
        return min(steps, steps_within((limit_s - gone_s) * done / gone_s, step, self._config))


LAMPS_AT = 0.6
"""Part of the steps after which lamps are looked for: Gaussians are split, colours have settled."""
LAMP_STEPS = 0.1
"""Images that are looked through for lamps, as a part of the steps."""


@dataclass(frozen=True, kw_only=True, eq=False)
class FitProgress:
    """How far a fit is: told when it is planned, while its first scene is made, at every step."""

    plan: FitPlan
    step: int = 0
    """Steps that are done."""
    share: float = 0.0
    """Part of the work of all steps that is done, 0 to 1; a limit of time may raise it at once."""
    placed: float | None = None
    """Part of the first scene that is made, as long as it is not whole."""
    entry: dict[str, float] | None = None
    """Newest entry of the history, if it has one."""


Progress = Callable[[FitProgress], None]


@runtime_checkable
class Onlooker(Protocol):
    """Who sees a fit while it runs, which changes no bit of what comes out."""

    def is_due(self, share_of_steps: float) -> bool:
        """Whether to show it the scene now, when so much of the steps (0 to 1) is done."""

    def show(self, scene: GaussianScene) -> None:
        """Show it the scene, whose Gaussians out of view lag a few steps behind.

        The fit waits meanwhile, and goes on with the same tensors.
        """


@dataclass(frozen=True, kw_only=True, eq=False)
class FitResult:
    """A fitted scene and how it came about."""

    scene: GaussianScene
    plan: FitPlan
    history: list[dict[str, float]]
    """Every so many steps: step, loss, psnr (training views), num_gaussians, cpu_s."""
    stopped_early: bool
    """Whether a limit of time left it fewer steps than planned."""


@dataclass(frozen=True, kw_only=True, eq=False)
class _Inputs:
    """What a fit reads, and who hears of it."""

    observations: SceneObservations
    guidance: Sequence[GuidanceView]
    checkpoints: CheckpointFolder | None
    progress: Progress
    onlooker: Onlooker | None
    perceptual: Perceptual | None


def fit_gaussians(  # noqa: PLR0913 - what was recorded, and one option each
    observations: SceneObservations,
    config: FitConfig,
    *,
    start: GaussianScene | None = None,
    guidance: Sequence[GuidanceView] = (),
    checkpoints: CheckpointFolder | None = None,
    progress: Progress | None = None,
    onlooker: Onlooker | None = None,
    perceptual: Perceptual | None = None,
    device: torch.device | None = None,
) -> FitResult:
    """Fit a scene.

    Args:
        observations: what was recorded: images in [0, 1] or bytes, depths and poses in metres, the
            world frame.
        config: settings; numbers that are 0 follow from the views.
        start: the scene to continue; without it one is made from the LiDAR map.
        guidance: painted views.
        checkpoints: where to keep the running fit; an existing checkpoint is taken up.
        progress: told about the plan, the first scene and every step.
        onlooker: shown the scene after steps at which it wants to see it.
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
    planned = partial(plan_fit, observations, config, start=start, guidance=guidance, device=device)
    inputs = _Inputs(
        observations=observations,
        guidance=guidance,
        checkpoints=checkpoints,
        progress=progress or (lambda _: None),
        onlooker=onlooker,
        perceptual=perceptual,
    )

    def attempt(spares: bool) -> FitResult:
        plan = planned(keeps_images=not spares)
        inputs.progress(FitProgress(plan=plan))
        return _follow(plan, _begun(plan, inputs, start), inputs)

    what = "the fit: a lower densification.budget or a narrower observation.width_px takes less"
    return within_memory(attempt, device, what)


def _begun(plan: FitPlan, inputs: _Inputs, start: GaussianScene | None) -> FitState:
    """Return the fit as a checkpoint kept it, or before its first step."""
    kept = inputs.checkpoints.load() if inputs.checkpoints is not None else None
    if kept is not None:
        return FitState.resume(
            *kept, plan.settings, plan.pixels_per_view, plan.device, inputs.perceptual
        )
    if start is None:
        return_freed_memory()  # of what prepared the observations
        start = initialise_scene(
            inputs.observations,
            plan.settings.initialisation,
            progress=lambda share: inputs.progress(FitProgress(plan=plan, placed=share)),
        )
    return FitState.begin(
        start.to(plan.device), plan.settings, plan.pixels_per_view, inputs.perceptual
    )


def _follow(plan: FitPlan, state: FitState, inputs: _Inputs) -> FitResult:
    cpu_before_s = time.process_time() - state.cpu_s
    config, views = plan.settings, inputs.observations.views
    full, half = fit_images(views, state.scene.sky.layout, half_too=config.half_resolution > 0)
    guidance = inputs.guidance
    if plan.keeps_images:
        full, half = ([image.to(plan.device) for image in images] for images in (full, half))
        guidance = [view.to(plan.device) for view in guidance]
    clock, onlooker = FitClock(state.step, config), inputs.onlooker
    while state.step < state.steps:
        is_half = state.step < config.half_resolution * state.steps
        row = state.next_view(plan.surface.groups)
        _advance(state, half if is_half else full, row, guidance)
        state.cpu_s = time.process_time() - cpu_before_s
        if state.step % config.log_every == 0 or state.step == state.steps:
            state.steps = clock.steps_in_time(state.step, state.steps)
            state.log()
        _tell(inputs.progress, plan, state)
        if onlooker is not None and onlooker.is_due(state.step / state.steps):
            onlooker.show(state.scene)  # to catch up now would round what is out of view anew
        if inputs.checkpoints is not None and inputs.checkpoints.is_due:
            inputs.checkpoints.save(*state.keep())
    return FitResult(
        scene=_finished(state),
        plan=plan,
        history=state.history,
        stopped_early=state.steps < config.steps,
    )


def _tell(progress: Progress, plan: FitPlan, state: FitState) -> None:
    work = partial(work_of, config=plan.settings, steps=state.steps)
    entry = state.history[-1] if state.history else None
    share = work(state.step) / work(state.steps)
    progress(FitProgress(plan=plan, step=state.step, share=share, entry=entry))


def _advance(
    state: FitState, images: Sequence[FitImage], row: int, guidance: Sequence[GuidanceView]
) -> None:
    """Make one step: gradients, optimisers, and at their times what changes the set."""
    painted, config = None, state.config
    if guidance and state.random() < config.guidance.probability:
        place = int(torch.randint(len(guidance), (), generator=state.generator))
        painted = (place, guidance[place].to(state.scene.device))
    image = images[row].to(state.scene.device)
    told = fit_step(state, image, row, painted)
    state.step += 1
    state.recent.append(told)
    _change_set(state)
    if config.refinement.lamps and not state.sought_lamps and not len(state.scene.blinking):
        _seek_lamps(state, images)
    if state.step % LIMITS_EVERY == 0:
        scene = state.caught_up()
        limit_shapes(scene.gaussians, viewing_rays(scene))
        state.blocks.refresh(scene.gaussians)


def _change_set(state: FitState) -> None:
    settings, fraction = state.config.densification, state.fraction
    if state.step % settings.every or fraction < settings.start or state.step == state.steps:
        return
    sizes = [track.size_m for track in state.scene.actors.recorded_tracks]
    gaussians = state.caught_up().gaussians
    if fraction > settings.stop:
        state.apply(prune(gaussians, sizes))
        return
    target = settings.allowed_now(len(gaussians), fraction, state.steps)
    state.apply(densify(gaussians, state.tally, sizes, target=target))


def _seek_lamps(state: FitState, images: Sequence[FitImage]) -> None:
    if state.step < LAMPS_AT * state.steps:
        return
    cameras = [
        image.camera.refined(state.refinement.world_from_camera(row, state.step).detach())
        for row, image in enumerate(images)
    ]
    most = math.ceil(LAMP_STEPS * state.steps)
    state.take_lamps(with_lamps_found(state.caught_up(), images, cameras, most))


def _finished(state: FitState) -> GaussianScene:
    """Return the scene without gradients, useless Gaussians or unseen sky."""
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
