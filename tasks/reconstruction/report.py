"""Write the page about a run: images, tables, curves, provenance."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from prefect import task

import lidarpainter_models
from catalog.artefacts import ArtefactRef, Workplace
from catalog.store import Store, open_store
from lidarpainter_models.conditioning.conditions import ConditionBuilder
from lidarpainter_models.evaluation.held_out import HeldOut
from lidarpainter_models.export.report import Comparison, Report, render_report
from lidarpainter_models.painter import load_painter
from lidarpainter_models.synthetic.street import SyntheticStreet
from tasks.evaluation.judging import GENERATOR_ENTRY
from tasks.evaluation.scene import JudgeSettings
from tasks.painter.painters import painter_digest
from tasks.reconstruction.comparisons import Subject, comparisons
from tasks.reconstruction.report_figures import plots, tables
from tasks.scenes import SplitSpec, open_split
from tasks.stages import STAGE_OPTIONS, StageResult, run_stage
from tasks.stored import FittedRef, load_observations, load_scene

REPORT_FILE = "report.html"


@dataclass(frozen=True, kw_only=True)
class ReportInputs:
    """What the page is about."""

    result: Mapping[str, Any]
    """What the command prints."""
    split: SplitSpec
    settings: JudgeSettings
    painter: str
    unpainted: FittedRef
    final: FittedRef
    stages: Mapping[str, StageResult]


@task(**STAGE_OPTIONS)
def write_report(store_path: Path, inputs: ReportInputs) -> StageResult:
    """Write the report of a run as an artefact."""
    store = open_store(store_path)

    def build(place: Workplace) -> dict[str, Any]:
        report = Report(
            title=f"LidarPainter: {inputs.result['scene']}",
            summary=_summary(inputs),
            comparisons=_comparisons(store, inputs),
            tables=tables(inputs.result, inputs.stages),
            plots=plots(inputs.stages),
            provenance=_provenance(store, inputs),
        )
        (place.output / REPORT_FILE).write_text(render_report(report), "utf-8")
        return {}

    return run_stage(
        store,
        stage="report",
        kind="report",
        inputs={name: stage.ref.digest for name, stage in inputs.stages.items()}
        | {"painter": painter_digest(inputs.painter)},
        config={"run": inputs.result["run_id"]},
        build=build,
    )


def report_path(ref: ArtefactRef) -> Path:
    """Where the page of a report artefact lies."""
    return ref.folder / REPORT_FILE


def _comparisons(store: Store, inputs: ReportInputs) -> list[Comparison]:
    recorded, views = open_split(store, inputs.split)
    judged = views.test or views.train
    seen = load_observations(store, inputs.final.observations)
    final = load_scene(store, inputs.final.gaussians)
    has_truth = GENERATOR_ENTRY in recorded.manifest
    subject = Subject(
        held_out=HeldOut(
            scene=recorded, test_views=judged, observation=inputs.settings.observation
        ),
        unpainted=load_scene(store, inputs.unpainted.gaussians),
        final=final,
        final_builder=ConditionBuilder(
            final, seen.lidar_map, seen.views, config=inputs.settings.conditions
        ),
        painter=load_painter(inputs.painter),
        street=SyntheticStreet.from_manifest(recorded.manifest) if has_truth else None,
    )
    return comparisons(subject, inputs.settings.scoring.shifts)


def _summary(inputs: ReportInputs) -> str:
    result = inputs.result
    rounds = "1 round" if result["rounds"] == 1 else f"{result['rounds']} rounds"
    return (
        f"Preset {result['preset']}, painter {result['painter']}, split {result['split']}, "
        f"{result['num_gaussians']} Gaussians. Painted means: after {rounds} of "
        "painting shifted views and fitting on with them."
    )


def _provenance(store: Store, inputs: ReportInputs) -> dict[str, str]:
    recorded, _views = open_split(store, inputs.split)
    return {
        "run": inputs.result["run_id"],
        "scene": inputs.result["scene"],
        "scene content": recorded.content_digest,
        "licence of the data": recorded.manifest["licence"],
        "painter": f"{inputs.painter} ({painter_digest(inputs.painter)})",
        "software": f"lidarpainter {lidarpainter_models.__version__}",
    }
