"""Enter a run into the catalog: when it starts, when it ends early, when it is done."""

from collections.abc import Mapping
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import lidarpainter_models
from catalog.artefacts import ArtefactRef
from catalog.digests import canonical_json, plain
from catalog.records import RunRecord, RunStatus, metric_row
from catalog.store import Store, open_store
from lidarpainter_models.evaluation.score_tables import metric_values, values_by_view
from tasks.json_files import finite_or_none
from tasks.opened import opened
from tasks.specs import RunSpec
from tasks.stages import stage_task


@stage_task
def begin_run(
    run: RunSpec,
    run_id: str,
    source_digest: str,
    preset: str,
    parameters: Any,  # noqa: ANN401 - anything with a canonical form
    *,
    derived_from: str | None = None,
    change: Any = None,  # noqa: ANN401 - likewise
) -> RunRecord:
    """Enter a run as running.

    The same run entered again takes the place of the first.
    """
    this = opened(run)
    record = RunRecord(
        run_id=run_id,
        scene_id=run.split.scene_id,
        scene_digest=this.scene.content_digest,
        preset=preset,
        painter=run.painter,
        parameters=canonical_json(plain(parameters)),
        source_digest=source_digest,
        software_version=lidarpainter_models.__version__,
        started_at=datetime.now(UTC),
        device=str(this.device),
        derived_from=derived_from,
        change=None if change is None else canonical_json(plain(change)),
    )
    this.store.tables.merge("runs", [record.row()])
    return record


@stage_task
def end_run(store_path: Path, record: RunRecord, status: RunStatus, error: str | None) -> None:
    """Enter that a run failed, and why, or that it was interrupted."""
    ended = replace(record, status=status, error=error, finished_at=datetime.now(UTC))
    open_store(store_path).tables.merge("runs", [ended.row()])


@stage_task
def complete_run(
    store_path: Path,
    record: RunRecord,
    result: Mapping[str, Any],
    scores: Mapping[str, Mapping[str, Any]],
    artefacts: tuple[ArtefactRef, ...],
) -> dict[str, Any]:
    """Enter a finished run and every number of it.

    `result` is what the command prints, with names relative to the store for paths; scores are by
    variant (`unpainted`, `painted`, ...).

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
    rows = []
    for variant, found in scores.items():
        by_view = values_by_view(found)
        for protocol, trajectory, name, value, reason in metric_values(found):
            views = by_view.get((protocol, trajectory, name))
            row = metric_row(
                run_id,
                scene_id,
                variant,
                protocol=protocol,
                trajectory=trajectory,
                name=name,
                value=value,
                reason=reason,
                by_view=None if views is None else canonical_json(views),
            )
            rows.append(row)
    store.tables.merge("metrics", rows)
