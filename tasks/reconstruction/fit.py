"""Fit Gaussians to observations, from scratch or on from a fitted scene."""

import logging
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from functools import partial
from typing import Any

import cv2
import torch

from catalog.artefacts import ArtefactRef, Workplace
from lidarpainter_models.gaussians.fitting.checkpoint import CheckpointFolder
from lidarpainter_models.gaussians.fitting.config import FitConfig
from lidarpainter_models.gaussians.fitting.fit import FitResult, fit_gaussians
from lidarpainter_models.gaussians.fitting.step import Perceptual
from lidarpainter_models.gaussians.model.gaussian_scene import GaussianScene, describe
from lidarpainter_models.gaussians.model.stored_scene import copy_scene
from lidarpainter_models.metrics.lpips import load_lpips
from lidarpainter_models.metrics.lpips_files import LpipsFiles
from lidarpainter_models.observations.views import GuidanceView, SceneObservations
from tasks.opened import opened
from tasks.progress import Progress
from tasks.specs import RunSpec
from tasks.stages import StageResult, run_stage, stage_task
from tasks.stored import load_observations, load_scene, save_scene
from tasks.weights import file_digests

_LOG = logging.getLogger("lidarpainter")
CHECKPOINT_EVERY_S = 10.0
"""A killed fit repeats at most this much."""
LOOK_FILE = "first-look.png"
"""The scene after a tenth of its first fit, where the checkpoints lie, until the fit is done."""


@stage_task
def fit(
    run: RunSpec,
    stage: str,
    observations: ArtefactRef,
    config: FitConfig,
    *,
    start: ArtefactRef | None = None,
    lpips: LpipsFiles | None = None,
) -> StageResult:
    """Fit a scene to what was recorded.

    Without a `start` it begins with the LiDAR map; one that goes on is the control of one that does
    so with painted views (`refine`).
    """
    this = opened(run)
    weighed = lpips if config.weighs_perceptual else None
    inputs = {"observations": observations, "start": start}
    return run_stage(
        this.store,
        kernels=run.kernels,
        stage=stage,
        kind="gaussians",
        inputs={name: ref.digest for name, ref in inputs.items() if ref is not None}
        | (file_digests(weighed.named) if weighed is not None else {}),
        config=asdict(config),
        build=partial(
            _build,
            observations=partial(load_observations, this.store, observations),
            start=partial(load_scene, this.store, start) if start is not None else None,
            perceptual=partial(load_lpips, weighed, this.device) if weighed is not None else None,
            config=config,
            device=this.device,
        ),
    )


def _build(
    place: Workplace,
    progress: Progress,
    *,
    observations: Callable[[], SceneObservations],
    start: Callable[[], GaussianScene] | None,
    perceptual: Callable[[], Perceptual | None] | None,
    config: FitConfig,
    device: torch.device,
) -> dict[str, Any]:
    result = run_fit(
        place,
        progress,
        observations(),
        config,
        start=start() if start else None,
        perceptual=perceptual() if perceptual else None,
        device=device,
    )
    save_scene(place.output, result.scene, result.history)
    return fit_summary(result)


def run_fit(  # noqa: PLR0913 - as `fit_gaussians`
    place: Workplace,
    progress: Progress,
    seen: SceneObservations,
    config: FitConfig,
    *,
    start: GaussianScene | None,
    guidance: Sequence[GuidanceView] = (),
    perceptual: Perceptual | None,
    device: torch.device,
) -> FitResult:
    """Fit where a stage is built: resumed from what a killed one left, and telling how far it is.

    A `start` stays as it is.
    """
    plan, shown = "", ""

    def look(scene: GaussianScene) -> None:
        nonlocal shown
        view = seen.views[len(seen.views) // 2]
        image = scene.render(
            view.camera, view.timestamp_ns, camera_name=view.key[1], view_key=view.key
        )
        path = place.scratch / LOOK_FILE
        rgb_u8 = (image.rgb.clamp(0, 1).cpu() * 255).round().to(torch.uint8).numpy()
        # by OpenCV alone: how files are exported is no part of a fit's key
        cv2.imwrite(str(path), cv2.cvtColor(rgb_u8, cv2.COLOR_RGB2BGR))
        shown = f", first look: {path}"
        _LOG.info("a fit of %d steps%s", config.steps, shown)

    def told(step: int, steps: int, entry: dict[str, float]) -> None:
        nonlocal plan
        if "planned_bytes" in entry:
            note = plan = _told_plan(steps, entry, device)
            _LOG.info("a fit: %s", plan)
        elif "initialised" in entry:
            note = f"placing Gaussians, {100 * entry['initialised']:.0f} %"
        else:
            note = f"{_told_step(entry)}; {plan}{shown}"
        planned = replace(config, steps=steps)
        progress(planned.work(step) / planned.work(steps), 1.0, note)

    return fit_gaussians(
        seen,
        config,
        start=copy_scene(start) if start else None,
        guidance=guidance,
        checkpoints=CheckpointFolder(
            path=place.scratch, identity=place.scratch.name, every_seconds=CHECKPOINT_EVERY_S
        ),
        progress=told,
        first_look=None if start else look,
        perceptual=perceptual,
        device=device,
    )


def fit_summary(result: FitResult) -> dict[str, Any]:
    """What a manifest says of a fit."""
    last = result.history[-1]
    return {
        **describe(result.scene),
        "train_psnr": last["psnr"],
        "cpu_s": last["cpu_s"],
        "steps": int(last["step"]),
        "stopped_early": result.stopped_early,
    }


def _told_step(entry: dict[str, float]) -> str:
    """Such as `step 2,400, 28.61 dB, 210k Gaussians`."""
    return (
        f"step {entry['step']:,.0f}, {entry['psnr']:.2f} dB, "
        f"{in_thousands(entry['num_gaussians'])} Gaussians"
    )


def _told_plan(steps: int, entry: dict[str, float], device: torch.device) -> str:
    """Such as `84 views, 0.9 Mpx of surface, at most 210k Gaussians, 4,800 steps, 1 GB on cpu`."""
    return (
        f"{entry['num_views']:.0f} views, {entry['surface_pixels'] / 1e6:.2g} Mpx of surface, "
        f"at most {in_thousands(entry['most_gaussians'])} Gaussians, {steps:,} steps, "
        f"{entry['planned_bytes'] / 1e9:.2g} GB on {device}"
    )


def in_thousands(count: float) -> str:
    """Such as `850`, `9.8k`, `210k` or `3,050k`."""
    if count < 1000:
        return f"{count:.0f}"
    return f"{count / 1000:,.{1 if count < 10_000 else 0}f}k"
