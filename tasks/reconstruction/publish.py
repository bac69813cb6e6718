"""Enter a run into the catalog: when it starts, when it fails, when it is done."""

from collections.abc import Mapping
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from prefect import task

import lidarpainter_models
from catalog.artefacts import ArtefactRef
from catalog.digests import canonical_json, plain
from catalog.records import MetricRecord, RunRecord, metric_rows, run_id_of
from catalog.store import Store, open_store
from tasks.evaluation.scene import evaluate
from tasks.evaluation.scores import metric_values
from tasks.json_files import finite_or_none
from tasks.reconstruction.fit import fit, refine
from tasks.reconstruction.paint import paint
from tasks.reconstruction.prepare import prepare
from tasks.reconstruction.report import write_report
from tasks.scenes import open_scene
from tasks.stages import STAGE_OPTIONS, code_digest

STAGES = (prepare, fit, refine, paint, evaluate, write_report)
"""What a run is made by: its id follows their code."""


@task(**STAGE_OPTIONS)
def begin_run(store_path: Path, parameters: Any, device: str) -> RunRecord:  # noqa: ANN401
    """Enter a run as running; the same scene content, parameters and code are the same run.

    Args:
        store_path: the store.
        parameters: the flow's parameters, with `scene`, `preset` and `painter`.
        device: what the fit runs on.
    """
    store = open_store(store_path)
    scene = open_scene(store, parameters.scene)
    source_digest = code_digest(*(stage.fn for stage in STAGES))
    record = RunRecord(
        run_id=run_id_of(scene.content_digest, parameters, source_digest),
        scene_id=parameters.scene,
        scene_digest=scene.content_digest,
        preset=parameters.preset,
        painter=parameters.painter,
        parameters=canonical_json(plain(parameters)),
        source_digest=source_digest,
        software_version=lidarpainter_models.__version__,
        started_at=datetime.now(UTC),
        device=device,
    )
    store.tables.merge("runs", [record.row()])
    return record


@task(**STAGE_OPTIONS)
def fail_run(store_path: Path, record: RunRecord, error: str) -> None:
    """Enter that a run failed, and why."""
    failed = replace(record, status="failed", error=error, finished_at=datetime.now(UTC))
    open_store(store_path).tables.merge("runs", [failed.row()])


@task(**STAGE_OPTIONS)
def complete_run(
    store_path: Path,
    record: RunRecord,
    result: Mapping[str, Any],
    scores: Mapping[str, Mapping[str, Any]],
    artefacts: tuple[ArtefactRef, ...],
) -> dict[str, Any]:
    """Enter a finished run and every number of it.

    Args:
        store_path: the store.
        record: as it was begun.
        result: what the command prints.
        scores: evaluations by variant (`unpainted`, `painted`, ...).
        artefacts: everything made or reused.

    Returns:
        The result, as stored.
    """
    store = open_store(store_path)
    stored = finite_or_none(result)
    done = replace(
        record,
        status="complete",
        finished_at=datetime.now(UTC),
        stage_seconds=canonical_json(stored["seconds"]),
        peak_memory_bytes=stored["peak_memory_bytes"],
        num_gaussians=stored["num_gaussians"],
        artefacts=tuple(ref.artefact_id for ref in artefacts),
        result=canonical_json(stored),
        report=stored["report"],
    )
    record_scores(store, record.run_id, record.scene_id, scores)
    store.tables.merge("runs", [done.row()])
    return stored


def record_scores(
    store: Store, run_id: str, scene_id: str, scores: Mapping[str, Mapping[str, Any]]
) -> None:
    """Enter every number of some evaluations, by variant (`unpainted`, `painted`, ...)."""
    records = [
        MetricRecord(
            run_id=run_id,
            scene_id=scene_id,
            protocol=protocol,
            trajectory=trajectory,
            variant=variant,
            name=name,
            value=value,
            reason=reason,
        )
        for variant, found in scores.items()
        for protocol, trajectory, name, value, reason in metric_values(found)
    ]
    store.tables.merge("metrics", metric_rows(records))
