"""Train a painter on pairs and enter it into the catalog.

Training is a stage like any other: keyed on the pairs and every setting, resumed from its last
checkpoint when it was killed.
"""

from datetime import datetime
from functools import partial
from pathlib import Path
from typing import Any

from catalog.artefacts import ArtefactRef, Workplace
from catalog.digests import DIGEST_LENGTH, canonical_json, digest_file
from catalog.store import Store, open_store
from lidarpainter_models.evaluation.painter_training import TrainingRequest
from lidarpainter_models.painter.known_painters import WEIGHTS_SUFFIX
from lidarpainter_models.painter.training.loop import TrainingProgress
from tasks.json_files import finite_or_none, read_json, write_json
from tasks.progress import Progress
from tasks.stages import StageResult, run_stage, stage_task

RECORD_SUFFIX = ".json"


@stage_task
def train(store_path: Path, stage: str, request: TrainingRequest) -> StageResult:
    """Train on all pairs but those held back.

    Raises:
        ConfigError: see `TrainingRequest.split` and `job_for`.
        WeightsError: the model or the first weights cannot be used.
    """
    job = request.job()
    learnt, _ = request.split(job)
    inputs = {f"pairs {name}": subset.digest for name, subset in learnt.items()}
    return run_stage(
        open_store(store_path),
        stage=stage,
        kind="painter",
        inputs=inputs | job.inputs,
        config={
            "training": request.config.to_dict(),
            "held_back": request.held_back,
            "num_processes": request.num_processes,
        },
        build=partial(_build_painter, request=request),
    )


def _build_painter(
    place: Workplace, progress: Progress, *, request: TrainingRequest
) -> dict[str, Any]:
    weights, record = request.train(place.scratch, place.output, partial(_tell, progress))
    write_json(weights.with_suffix(RECORD_SUFFIX), record)
    return {key: record[key] for key in ("num_pairs", "steps", "cpu_s")}


def _tell(progress: Progress, training: TrainingProgress) -> None:
    loss = training.losses.get("total")
    note = f"step {training.step}" + ("" if loss is None else f", loss {loss:.4f}")
    progress(training.share_done, 1.0, note)


@stage_task
def publish_painter(
    store_path: Path, trained: ArtefactRef, scores: dict[str, Any] | None
) -> dict[str, Any]:
    """Enter a painter into the catalog; returns its row."""
    store = open_store(store_path)
    weights = weights_path(store, trained)
    manifest = store.artefacts.verified(trained)
    row = {
        "painter_id": digest_file(weights)[:DIGEST_LENGTH],
        "name": weights.stem,
        "path": store.name_of(weights),
        "num_bytes": weights.stat().st_size,
        "record": canonical_json(training_record(store, trained, scores)),
        "created_at": datetime.fromisoformat(manifest.created_at),
        "software_version": manifest.software_version,
    }
    store.tables.merge("painters", [row])
    return row


def weights_path(store: Store, trained: ArtefactRef) -> Path:
    """The weights of a trained painter, called after its kind."""
    (path,) = store.artefacts.files(trained).glob(f"*{WEIGHTS_SUFFIX}")
    return path


def training_record(
    store: Store, trained: ArtefactRef, scores: dict[str, Any] | None
) -> dict[str, Any]:
    """How a painter was trained and what it reached on the pairs held back."""
    record = read_json(weights_path(store, trained).with_suffix(RECORD_SUFFIX))
    return finite_or_none(record | {"held_back_scores": scores})
