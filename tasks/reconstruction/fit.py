"""Fit Gaussians to observations, from scratch or on from a fitted scene with painted views."""

from dataclasses import asdict
from pathlib import Path
from typing import Any

from prefect import task

from catalog.artefacts import ArtefactRef, Workplace
from catalog.store import Store, open_store
from lidarpainter_models.gaussians.fitting.checkpoint import CheckpointFolder
from lidarpainter_models.gaussians.fitting.config import FitConfig
from lidarpainter_models.gaussians.fitting.fit import FitResult, fit_gaussians
from lidarpainter_models.gaussians.model.scene_graph import describe
from tasks.progress import listener
from tasks.reconstruction.painted_views import load_guidance
from tasks.stages import STAGE_OPTIONS, StageResult, run_stage
from tasks.stored import load_observations, load_scene, save_scene

CHECKPOINT_EVERY_S = 10.0
"""A killed fit repeats at most this much."""


@task(**STAGE_OPTIONS)
def fit(store_path: Path, observations: ArtefactRef, config: FitConfig) -> StageResult:
    """Fit a scene to what was recorded."""
    return _run(open_store(store_path), "fit", observations, config, None, None)


@task(**STAGE_OPTIONS)
def refine(
    store_path: Path,
    stage: str,
    observations: ArtefactRef,
    start: ArtefactRef,
    guidance: ArtefactRef | None,
    config: FitConfig,
) -> StageResult:
    """Go on fitting, with painted views or, as an equally long control, without."""
    return _run(open_store(store_path), stage, observations, config, start, guidance)


def _run(
    store: Store,
    stage: str,
    observations: ArtefactRef,
    config: FitConfig,
    start: ArtefactRef | None,
    guidance: ArtefactRef | None,
) -> StageResult:
    inputs = {"observations": observations, "start": start, "guidance": guidance}

    def told(step: int, steps: int, entry: dict[str, float]) -> None:
        note = f"{entry['psnr']:.2f} dB, {entry['num_gaussians'] / 1000:.0f}k Gaussians"
        listener().advanced(stage, step, steps, note)

    def build(place: Workplace) -> dict[str, Any]:
        result = fit_gaussians(
            load_observations(store, observations),
            config,
            start=load_scene(store, start) if start else None,
            guidance=load_guidance(store, guidance) if guidance else (),
            checkpoints=CheckpointFolder(
                path=place.scratch, identity=place.scratch.name, every_seconds=CHECKPOINT_EVERY_S
            ),
            progress=told,
        )
        save_scene(place.output, result.scene, result.history)
        return _summary(result)

    return run_stage(
        store,
        stage=stage,
        kind="gaussians",
        inputs={name: ref.digest for name, ref in inputs.items() if ref is not None},
        config=asdict(config),
        build=build,
    )


def _summary(result: FitResult) -> dict[str, Any]:
    last = result.history[-1]
    return {
        **describe(result.scene),
        "train_psnr": last["psnr"],
        "cpu_s": last["cpu_s"],
        "steps": int(last["step"]),
    }
