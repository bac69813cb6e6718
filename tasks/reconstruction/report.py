"""Write the page about a run: images, tables, curves, provenance, machine, settings."""

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import torch

import lidarpainter_models
from catalog.artefacts import ArtefactRef, Workplace
from catalog.store import Store
from lidarpainter_models.evaluation.held_out import HeldOut
from lidarpainter_models.evaluation.settings import EvaluationConfig
from lidarpainter_models.evaluation.shown import ViewTimePainting
from lidarpainter_models.export.pictures import (
    comparisons,
    recorded_beside,
    worst_views,
    write_beside,
)
from lidarpainter_models.export.report import render_report
from lidarpainter_models.export.run_page import Pictures, RunPage, StageCost
from lidarpainter_models.gaussians.model.gaussian_scene import GaussianScene
from lidarpainter_models.geometry.shifts import Shift
from lidarpainter_models.observations.own_body import in_words
from lidarpainter_models.observations.views import SceneObservations
from tasks.evaluation.shown import painted_by
from tasks.machine import machine
from tasks.opened import OpenedRun, opened
from tasks.progress import Progress
from tasks.reconstruction.examine import STAGE as EXAMINE
from tasks.reconstruction.examine import suspicions
from tasks.specs import FittedRef, RunSpec
from tasks.stages import StageResult, run_stage, stage_task
from tasks.stored import History, load_history, load_observations, load_scene

REPORT_FILE = "report.html"
WORST_FILE = "worst.jpg"
"""The worst view beside what was recorded, for pages about many runs."""


@dataclass(frozen=True, kw_only=True)
class ReportInputs:
    """What the page is about."""

    result: Mapping[str, Any]
    """What the command prints, by its keys."""
    source_digest: str
    """Digest of the code behind the run."""
    unpainted: FittedRef
    final: FittedRef
    stages: Mapping[str, StageResult]


@stage_task
def write_report(run: RunSpec, inputs: ReportInputs, config: EvaluationConfig) -> StageResult:
    """Write the report of a run as an artefact."""
    this = opened(run)
    stages = inputs.stages
    fits = {name: made.ref for name, made in stages.items() if made.ref.kind == "gaussians"}
    return run_stage(
        this.store,
        kernels=run.kernels,
        stage="report",
        kind="report",
        inputs={name: stage.ref.digest for name, stage in stages.items()}
        | {"painter": this.painter.digest},
        config={"run": inputs.result["run_id"]},
        build=partial(
            _build,
            page=RunPage(
                result=inputs.result,
                costs=[_cost(name, made) for name, made in stages.items()],
                provenance=_provenance(this, inputs),
                settings=_settings(this.store, inputs.result["run_id"]),
                has_lidar=this.scene.has_lidar(this.views.train_frames),
            ),
            histories=partial(_histories, this.store, fits),
            held_out=this.held_out(config.observation, or_train=True),
            shifts=config.scoring.shifts,
            observations=partial(load_observations, this.store, inputs.final.observations),
            said=suspicions(stages[EXAMINE]) if EXAMINE in stages else (),
            unpainted=partial(load_scene, this.store, inputs.unpainted.gaussians),
            painting=painted_by(this, inputs.final, config.conditions),
        ),
    )


def _build(  # noqa: PLR0913 - all that the page is made from
    place: Workplace,
    progress: Progress,
    *,
    page: RunPage,
    histories: Callable[[], dict[str, History]],
    held_out: HeldOut,
    shifts: Sequence[Shift],
    observations: Callable[[], SceneObservations],
    said: Sequence[str],
    unpainted: Callable[[], GaussianScene],
    painting: Callable[[], ViewTimePainting],
) -> dict[str, Any]:
    painted = painting()
    pictures = _pictures(held_out, unpainted(), painted, shifts, said, progress)
    report = replace(page, is_estimated=observations().is_estimated).report(
        held_out.scene, pictures, histories(), machine(painted.device)
    )
    (place.output / REPORT_FILE).write_text(render_report(report), "utf-8")
    if pictures.worst:
        write_beside(pictures.worst[0], place.output / WORST_FILE)
    return {}


def _pictures(
    held_out: HeldOut,
    unpainted: GaussianScene,
    painting: ViewTimePainting,
    shifts: Sequence[Shift],
    said: Sequence[str],
    progress: Progress,
) -> Pictures:
    fitted = painting.conditions.scene
    beside = shifts[0] if shifts else Shift(lateral_m=2.0)
    bodies = fitted.gaussians.body_index.long().cpu()
    names = [track.actor_id for track in fitted.actors.recorded_tracks]
    counts = torch.bincount(bodies, minlength=1 + len(names))[1:].tolist()
    return Pictures(
        comparisons=comparisons(held_out, unpainted, painting, shifts, progress=progress),
        moving=recorded_beside(held_out, fitted, beside),
        worst=worst_views(held_out, fitted),
        actor_gaussians=dict(zip(names, counts, strict=True)),
        found=[
            *said,
            *fitted.cameras.path.in_words(),
            *(f"{name} {fault}; corrected." for name, fault in fitted.cameras.faults.items()),
            *(in_words(name, body) for name, body in fitted.cameras.own_bodies.items()),
            *fitted.blinking.in_words(names),
        ],
    )


def _cost(name: str, stage: StageResult) -> StageCost:
    return StageCost(
        stage=name,
        seconds=stage.seconds,
        cpu_seconds=stage.cpu_seconds,
        peak_memory_bytes=stage.peak_memory_bytes,
        artefact=stage.ref.digest,
    )


def _histories(store: Store, fits: Mapping[str, ArtefactRef]) -> dict[str, History]:
    return {name: load_history(store, ref) for name, ref in fits.items()}


def _settings(store: Store, run_id: str) -> dict[str, str]:
    """The settings of a run by dotted name, as they were entered into the catalog."""
    return dict(_flat("", json.loads(store.run(run_id)["parameters"])))


def _flat(name: str, value: Any) -> Iterator[tuple[str, str]]:  # noqa: ANN401 - any JSON value
    if isinstance(value, dict) and value:
        for key, inner in value.items():
            yield from _flat(f"{name}.{key}" if name else key, inner)
    else:
        yield name, value if isinstance(value, str) else json.dumps(value)


def _provenance(this: OpenedRun, inputs: ReportInputs) -> dict[str, str]:
    return {
        "run": inputs.result["run_id"],
        "scene": inputs.result["scene"],
        "scene content": this.scene.content_digest,
        "licence of the data": this.scene.manifest["licence"],
        "painter": f"{this.spec.painter} ({this.painter.digest})",
        "software": f"lidarpainter {lidarpainter_models.__version__}",
        "source": inputs.source_digest,
    }
