"""Fit Gaussians to observations: from scratch, or continued from a fitted scene in a round.

A running fit is kept below `STORE/work/`, in a folder of its stage's key, until its artefact is
whole: checkpoints (`fit.safetensors`) and the first look (`first-look.png`).
"""

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import torch

from catalog.artefacts import ArtefactRef, Workplace
from catalog.store import Store
from lidarpainter_models.evaluation.round_gain import round_gain
from lidarpainter_models.gaussians.fitting.checkpoint import CheckpointFolder
from lidarpainter_models.gaussians.fitting.config import FitConfig
from lidarpainter_models.gaussians.fitting.fit import FitProgress, FitResult, fit_gaussians
from lidarpainter_models.gaussians.fitting.loss import Perceptual
from lidarpainter_models.gaussians.fitting.plan import in_thousands
from lidarpainter_models.gaussians.model.gaussian_scene import GaussianScene, describe
from lidarpainter_models.gaussians.model.stored_scene import copy_scene
from lidarpainter_models.metrics.lpips import load_lpips
from lidarpainter_models.metrics.lpips_files import LpipsFiles
from lidarpainter_models.observations.views import GuidanceView, SceneObservations
from tasks.opened import opened
from tasks.progress import Progress, listener
from tasks.reconstruction.paint import load_guidance
from tasks.specs import FittedRef, RunSpec
from tasks.stages import StageResult, run_stage, stage_task
from tasks.stored import load_observations, load_scene, save_scene
from tasks.weights import file_digests

_LOG = logging.getLogger("lidarpainter")
CHECKPOINT_EVERY_S = 10.0
"""A killed fit repeats at most this much."""
FIRST_LOOK = 0.1
"""Part of the steps after which the scene is shown for the first time."""
LOOK_FILE = "first-look.png"
"""The scene after a tenth of its first fit, where the checkpoints lie, until the fit is done."""
FIT_OF_ROUND = 0.7
"""Part of a painted round's time that its steps take; the rest tells whether views became worse."""


@dataclass(frozen=True, kw_only=True)
class _Sources:
    """What a fit is made from, read when its stage is built."""

    store: Store
    refs: Mapping[str, ArtefactRef]
    """The inputs that there are, by the part they play."""
    perceptual: Callable[[], Perceptual | None] | None
    """Reads the distance of images that the loss weighs, if it weighs one; of its code nothing is
    part of a fit's key, its weights are among the digests."""
    config: FitConfig
    device: torch.device

    def observations(self) -> SceneObservations:
        """Read what was recorded."""
        return load_observations(self.store, self.refs["observations"])

    def start(self) -> GaussianScene | None:
        """Read the scene that is continued, if there is one."""
        return load_scene(self.store, self.refs["start"]) if "start" in self.refs else None

    def guidance(self) -> tuple[GuidanceView, ...]:
        """Read the painted views, none if nothing was painted."""
        return load_guidance(self.store, self.refs["guidance"]) if "guidance" in self.refs else ()


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

    Without a `start` it begins with the LiDAR map; one that is continued is the control of one that
    is continued with painted views (`refine`).
    """
    inputs = {"observations": observations, "start": start}
    return _stage(run, stage, config, lpips, inputs, _build)


@stage_task
def refine(
    run: RunSpec,
    stage: str,
    fitted: FittedRef,
    config: FitConfig,
    *,
    guidance: ArtefactRef,
    lpips: LpipsFiles | None = None,
) -> StageResult:
    """Continue the fit of a scene with views that were painted of it.

    The summary's `gain` says whether the round is to be taken back; it is kept here all the same.
    """
    inputs = {"observations": fitted.observations, "start": fitted.gaussians, "guidance": guidance}
    return _stage(run, stage, config, lpips, inputs, _build_round)


def _stage(
    run: RunSpec,
    stage: str,
    config: FitConfig,
    lpips: LpipsFiles | None,
    inputs: Mapping[str, ArtefactRef | None],
    build: Callable[..., dict[str, Any]],
) -> StageResult:
    """Fit from stored inputs, by the part they play."""
    this = opened(run)
    weighed = lpips if config.weighs_perceptual else None
    there = {name: ref for name, ref in inputs.items() if ref is not None}
    sources = _Sources(
        store=this.store,
        refs=there,
        perceptual=partial(load_lpips, weighed, this.device) if weighed is not None else None,
        config=config,
        device=this.device,
    )
    digests = {name: ref.digest for name, ref in there.items()}
    return run_stage(
        this.store,
        kernels=run.kernels,
        stage=stage,
        kind="gaussians",
        inputs=digests | (file_digests(weighed.named) if weighed is not None else {}),
        config=asdict(config),
        build=partial(build, sources=sources),
    )


class _Looks:
    """Shows a running fit: its first look in a file, and all of it to whoever watches."""

    said = ""
    """Where the first look lies, once there is one."""

    def __init__(self, seen: SceneObservations, file: Path, *, is_first_fit: bool) -> None:
        self._seen, self._file, self._watch = seen, file, listener().watch
        self._is_expected = is_first_fit

    def is_due(self, share_of_steps: float) -> bool:
        """Whether the first look is to be had, or whoever watches wants to see more."""
        is_watched = self._watch is not None and self._watch.is_due()
        return is_watched or (self._is_expected and share_of_steps >= FIRST_LOOK)

    def show(self, scene: GaussianScene) -> None:
        """Write the first look if it is not there, and show the scene to whoever watches."""
        if self._is_expected:
            self._is_expected = False
            self._write(scene)
        if self._watch is not None:
            self._watch.show(scene, self._seen.views)

    def _write(self, scene: GaussianScene) -> None:
        view = self._seen.views[len(self._seen.views) // 2]
        image = scene.render(
            view.camera, view.timestamp_ns, camera_name=view.key[1], view_key=view.key
        )
        rgb_u8 = (image.rgb.clamp(0, 1).cpu() * 255).round().to(torch.uint8).numpy()
        # by OpenCV alone: how files are exported is no part of a fit's key
        cv2.imwrite(str(self._file), cv2.cvtColor(rgb_u8, cv2.COLOR_RGB2BGR))
        self.said = f", first look: {self._file}"
        _LOG.info("a fit%s", self.said)


def _build(place: Workplace, progress: Progress, *, sources: _Sources) -> dict[str, Any]:
    result = _run(place, progress, sources, sources.observations(), sources.start())
    save_scene(place.output, result.scene, result.history)
    return _summary(result)


def _build_round(place: Workplace, progress: Progress, *, sources: _Sources) -> dict[str, Any]:
    seen, before, painted = sources.observations(), sources.start(), sources.guidance()

    def told(done: float, total: float, note: str = "") -> None:
        progress(done * (FIT_OF_ROUND if painted else 1.0), total, note)

    result = _run(place, told, sources, seen, before, painted)
    gain = None
    if painted and before is not None:
        progress(FIT_OF_ROUND, 1.0, "whether views became better")
        found = round_gain(before.to(sources.device), result.scene, seen, painted)
        gain = {**asdict(found), "is_taken_back": found.is_worse}
    save_scene(place.output, result.scene, result.history)
    return {**_summary(result), "gain": gain}


def _run(
    place: Workplace,
    progress: Progress,
    sources: _Sources,
    seen: SceneObservations,
    start: GaussianScene | None,
    guidance: Sequence[GuidanceView] = (),
) -> FitResult:
    """Fit where a stage is built: resumed from what a killed one left, and telling how far it is.

    A `start` stays as it is.
    """
    plan = ""
    looks = _Looks(seen, place.scratch / LOOK_FILE, is_first_fit=start is None)

    def told(now: FitProgress) -> None:
        nonlocal plan
        note = f"{plan}{looks.said}"
        if now.placed is not None:
            note = f"placing Gaussians, {100 * now.placed:.0f} %"
        elif now.entry is not None:
            note = f"{_in_words(now.entry)}; {note}"
        elif now.step == 0:
            note = plan = now.plan.in_words()
            _LOG.info("a fit: %s; checkpoints in %s", plan, place.scratch)
        progress(now.share, 1.0, note)

    return fit_gaussians(
        seen,
        sources.config,
        start=copy_scene(start) if start else None,
        guidance=guidance,
        checkpoints=CheckpointFolder(
            path=place.scratch, identity=place.scratch.name, every_seconds=CHECKPOINT_EVERY_S
        ),
        progress=told,
        onlooker=looks,
        perceptual=sources.perceptual() if sources.perceptual else None,
        device=sources.device,
    )


def _summary(result: FitResult) -> dict[str, Any]:
    """Return what a manifest says of a fit: its plan and what came of it."""
    last = result.history[-1]
    return {
        **describe(result.scene),
        "plan": result.plan.numbers(),
        "train_psnr": last["psnr"],
        "cpu_s": last["cpu_s"],
        "steps": int(last["step"]),
        "stopped_early": result.stopped_early,
    }


def _in_words(entry: Mapping[str, float]) -> str:
    """Return such as `step 2,400, 28.61 dB, 210k Gaussians`."""
    return (
        f"step {entry['step']:,.0f}, {entry['psnr']:.2f} dB, "
        f"{in_thousands(entry['num_gaussians'])} Gaussians"
    )
