"""Train a painter on pairs and enter it into the catalog.

Training is a stage like any other: keyed on the pairs and every setting, resumed from its last
checkpoint when it was killed.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import Any

import torch
from prefect import task

import lidarpainter_models
from catalog.artefacts import ArtefactRef, Workplace
from catalog.digests import DIGEST_LENGTH, canonical_json, digest_file
from catalog.store import Store, open_store
from lidarpainter_models.evaluation.held_back import (
    TARGETS_KEY,
    PairSubset,
    check_training_pairs,
    first_targets,
    hold_back,
)
from lidarpainter_models.metrics.lpips import LpipsFiles
from lidarpainter_models.painter.one_step.job import NO_FILES
from lidarpainter_models.painter.selection import WEIGHTS_SUFFIX
from lidarpainter_models.painter.training.job import TrainingJob
from lidarpainter_models.painter.training.loop import TrainingProgress
from lidarpainter_models.painter.training_jobs import PainterTraining, job_for
from lidarpainter_models.readers.pandaset.reader import LICENCE as PANDASET_LICENCE
from lidarpainter_models.training_data.pair_sets import PairSet, open_sets
from lidarpainter_models.training_data.pairs import PairFolder
from tasks.json_files import finite_or_none, read_json, write_json
from tasks.progress import Progress
from tasks.stages import STAGE_OPTIONS, StageResult, run_stage

RECORD_SUFFIX = ".json"
LICENCE = "Apache-2.0"
ATTRIBUTIONS = {
    "synthetic": "LidarPainter's synthetic street, Apache-2.0",
    "pandaset": PANDASET_LICENCE,
}
"""Whom to name for data sets whose terms let trained weights be given on."""


@dataclass(frozen=True, kw_only=True)
class TrainingRequest:
    """What is trained, on what, and how."""

    sets: tuple[PairSet, ...]
    """Pairs to learn from and to judge by."""
    config: PainterTraining
    """The recipe."""
    held_back: float = 0.0
    """Share of the true images kept as the validation split."""
    start: str | Path | None = None
    """Weights to go on from, a name or a file; for the one-step painter also its model."""
    lpips: LpipsFiles = NO_FILES
    """Weights for the loss of the one-step painter."""
    device: str = "cpu"
    """Where the one-step painter is trained in one process."""
    num_processes: int = 1
    """In which the one-step painter is trained, each on a GPU."""

    def job(self) -> TrainingJob:
        """The painter in training; see `job_for`."""
        return job_for(
            self.config,
            self.start,
            self.lpips,
            device=torch.device(self.device),
            num_processes=self.num_processes,
        )

    def split(self, job: TrainingJob) -> tuple[dict[str, PairSubset], dict[str, PairSubset]]:
        """Pairs to learn from and the validation split, by name.

        Raises:
            ConfigError: pairs of a street that is kept for judging, nothing left to learn from, or
                first weights that do not say what they have learnt.
        """
        folders = open_sets(self.sets)
        for folder in folders.values():
            check_training_pairs(folder)
        return hold_back(folders, self.held_back, known=first_targets(job))


@task(**STAGE_OPTIONS)
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
    job = request.job()
    learnt, judged = request.split(job)
    folders = open_sets(request.sets).values()
    for folder in folders:
        folder.verify()
    trained = job.train(list(learnt.values()), place.scratch, partial(_tell, progress))
    of_pairs, attribution = _terms(folders)
    licence = job.licence(of_pairs)
    record = {
        "licence": licence,
        "attribution": attribution,
        "held_back": {name: sorted(subset.targets) for name, subset in judged.items()},
        "software_version": lidarpainter_models.__version__,
        **trained,
        **job.origin,
    }
    provenance = _provenance(record, learnt.values()) | job.origin
    provenance[TARGETS_KEY] = sorted({*provenance[TARGETS_KEY], *first_targets(job)})
    job.save(place.output / f"{job.name}{WEIGHTS_SUFFIX}", licence=licence, provenance=provenance)
    write_json(place.output / f"{job.name}{RECORD_SUFFIX}", record)
    return {key: record[key] for key in ("num_pairs", "steps", "cpu_s")}


def _tell(progress: Progress, training: TrainingProgress) -> None:
    loss = training.losses.get("total")
    note = f"step {training.step}" + ("" if loss is None else f", loss {loss:.4f}")
    progress(training.share_done, 1.0, note)


@task(**STAGE_OPTIONS)
def publish_painter(
    store_path: Path, trained: ArtefactRef, scores: dict[str, Any] | None
) -> dict[str, Any]:
    """Enter a painter into the catalog; returns its row.

    Args:
        store_path: the store.
        trained: what `train` made.
        scores: its figures on held-back pairs, if there are any.
    """
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
    (path,) = store.artefacts.folder(trained).glob(f"*{WEIGHTS_SUFFIX}")
    return path


def training_record(
    store: Store, trained: ArtefactRef, scores: dict[str, Any] | None
) -> dict[str, Any]:
    """How a painter was trained and what it reached on the pairs held back."""
    record = read_json(weights_path(store, trained).with_suffix(RECORD_SUFFIX))
    return finite_or_none(record | {"held_back_scores": scores})


def _provenance(record: dict[str, Any], learnt: Iterable[PairSubset]) -> dict[str, Any]:
    """What goes into the weights file: enough to know its origin and what must not judge it."""
    sets = list(learnt)
    kept = ("attribution", "training_digest", "num_pairs", "steps", "cpu_s", "seed", "torch")
    return {
        **{key: record[key] for key in kept},
        "software_version": record["software_version"],
        "pairs": {one.set_name: {"digest": one.digest, "num_pairs": len(one)} for one in sets},
        TARGETS_KEY: sorted(frozenset().union(*(one.targets for one in sets))),
    }


def _terms(folders: Iterable[PairFolder]) -> tuple[str, list[str]]:
    """Licence of the weights, and whom to name."""
    datasets = sorted(
        {
            str(folder.provenance(index).get("dataset", "unknown"))
            for folder in folders
            for index in range(len(folder))
        }
    )
    foreign = [dataset for dataset in datasets if dataset not in ATTRIBUTIONS]
    licence = f"terms of the training data: {', '.join(foreign)}" if foreign else LICENCE
    return licence, [ATTRIBUTIONS.get(dataset, dataset) for dataset in datasets]
