"""Go on fitting a scene with painted views, and tell whether that made things worse."""

from collections.abc import Callable
from dataclasses import asdict
from functools import partial
from typing import Any

import torch

from catalog.artefacts import ArtefactRef, Workplace
from lidarpainter_models.evaluation.round_gain import round_gain
from lidarpainter_models.gaussians.fitting.config import FitConfig
from lidarpainter_models.gaussians.fitting.step import Perceptual
from lidarpainter_models.gaussians.model.gaussian_scene import GaussianScene
from lidarpainter_models.metrics.lpips import load_lpips
from lidarpainter_models.metrics.lpips_files import LpipsFiles
from lidarpainter_models.observations.views import GuidanceView, SceneObservations
from tasks.opened import opened
from tasks.progress import Progress
from tasks.reconstruction.fit import fit_summary, run_fit
from tasks.reconstruction.painted_views import load_guidance
from tasks.specs import FittedRef, RunSpec
from tasks.stages import StageResult, run_stage, stage_task
from tasks.stored import load_observations, load_scene, save_scene
from tasks.weights import file_digests


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
    """Go on fitting a scene with views that were painted of it.

    The summary's `gain` says whether the round is to be taken back; it is kept here all the same.
    """
    this = opened(run)
    weighed = lpips if config.weighs_perceptual else None
    inputs = {
        "observations": fitted.observations,
        "start": fitted.gaussians,
        "guidance": guidance,
    }
    return run_stage(
        this.store,
        kernels=run.kernels,
        stage=stage,
        kind="gaussians",
        inputs={name: ref.digest for name, ref in inputs.items()}
        | (file_digests(weighed.named) if weighed is not None else {}),
        config=asdict(config),
        build=partial(
            _build,
            observations=partial(load_observations, this.store, fitted.observations),
            start=partial(load_scene, this.store, fitted.gaussians),
            guidance=partial(load_guidance, this.store, guidance),
            perceptual=partial(load_lpips, weighed, this.device) if weighed is not None else None,
            config=config,
            device=this.device,
        ),
    )


def _build(  # noqa: PLR0913 - all that a fit is made from
    place: Workplace,
    progress: Progress,
    *,
    observations: Callable[[], SceneObservations],
    start: Callable[[], GaussianScene],
    guidance: Callable[[], tuple[GuidanceView, ...]],
    perceptual: Callable[[], Perceptual | None] | None,
    config: FitConfig,
    device: torch.device,
) -> dict[str, Any]:
    seen, before, painted = observations(), start(), guidance()
    result = run_fit(
        place,
        progress,
        seen,
        config,
        start=before,
        guidance=painted,
        perceptual=perceptual() if perceptual else None,
        device=device,
    )
    told = None
    if painted:
        gain = round_gain(before.to(device), result.scene, seen, painted)
        told = {**asdict(gain), "is_taken_back": gain.is_worse}
    save_scene(place.output, result.scene, result.history)
    return {**fit_summary(result), "gain": told}
