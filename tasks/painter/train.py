"""Train a painter on pairs and enter it into the catalog.

Training is a stage like any other: keyed on the pairs and every setting, resumed from its last
checkpoint when it was killed.
"""

from collections.abc import Iterable, Sequence
from datetime import datetime
from pathlib import Path
from typing import Any

from prefect import task

import lidarpainter_models
from catalog.artefacts import ArtefactRef, Workplace
from catalog.digests import DIGEST_LENGTH, canonical_json, digest_file
from catalog.store import Store, open_store
from lidarpainter_models.evaluation.held_back import (
    TARGETS_KEY,
    PairSubset,
    check_training_pairs,
    hold_back,
)
from lidarpainter_models.metrics.lpips import LpipsFiles
from lidarpainter_models.painter.training.loop import TrainingProgress
from lidarpainter_models.readers.pandaset.reader import LICENCE as PANDASET_LICENCE
from lidarpainter_models.training_data.pairs import PairFolder
from tasks.json_files import finite_or_none, read_json, write_json
from tasks.painter.harvest import PairSet
from tasks.painter.judge import open_sets
from tasks.painter.students import NO_FILES, PainterTraining, student_of
from tasks.progress import Progress, listener
from tasks.stages import STAGE_OPTIONS, StageResult, run_stage

WEIGHTS_SUFFIX = ".safetensors"
RECORD_SUFFIX = ".json"
LICENCE = "Apache-2.0"
ATTRIBUTIONS = {
    "synthetic": "LidarPainter's synthetic street, Apache-2.0",
    "pandaset": PANDASET_LICENCE,
}
"""Whom to name for data sets whose terms let trained weights be given on."""


@task(**STAGE_OPTIONS)
def train(  # noqa: PLR0913 - what a training stands on
    store_path: Path,
    stage: str,
    sets: Sequence[PairSet],
    config: PainterTraining,
    held_back: float,
    start: str | Path | None = None,
    lpips: LpipsFiles = NO_FILES,
    num_processes: int = 1,
) -> StageResult:
    """Train on all pairs but those held back.

    Args:
        store_path: the store.
        stage: its name for the listener.
        sets: pairs to learn from and to judge by.
        config: the recipe.
        held_back: share of the true images kept to judge by.
        start: weights to go on from, a name or a file; for the one-step painter also its model.
        lpips: weights for the loss of the one-step painter.
        num_processes: in which the one-step painter is trained, each on a GPU.

    Raises:
        ConfigError: pairs of a street that is kept for judging, nothing left to learn from, a loss
            that lacks what it weighs, or first weights that do not say what they have learnt.
        WeightsError: the model or the first weights cannot be used.
    """
    folders = open_sets(sets)
    for folder in folders.values():
        check_training_pairs(folder)
    student = student_of(config, start, lpips, num_processes)
    learnt, judged = hold_back(folders, held_back, known=student.learnt)

    def told(progress: TrainingProgress) -> None:
        loss = progress.losses.get("total")
        note = f"step {progress.step}" + ("" if loss is None else f", loss {loss:.4f}")
        listener().advanced(stage, progress.share_done, 1.0, note)

    def build(place: Workplace, _progress: Progress) -> dict[str, Any]:
        for folder in folders.values():
            folder.verify()
        trained = student.learn(list(learnt.values()), place.scratch, told)
        of_pairs, attribution = _terms(folders.values())
        licence = student.licence(of_pairs)
        record = {
            "licence": licence,
            "attribution": attribution,
            "held_back": {name: sorted(subset.targets) for name, subset in judged.items()},
            "software_version": lidarpainter_models.__version__,
            **trained,
            **student.origin,
        }
        provenance = _provenance(record, learnt.values()) | student.origin
        provenance[TARGETS_KEY] = sorted({*provenance[TARGETS_KEY], *student.learnt})
        student.save(
            place.output / f"{student.name}{WEIGHTS_SUFFIX}", licence=licence, provenance=provenance
        )
        write_json(place.output / f"{student.name}{RECORD_SUFFIX}", record)
        return {key: record[key] for key in ("num_pairs", "steps", "cpu_s")}

    inputs = {f"pairs {name}": subset.digest for name, subset in learnt.items()}
    return run_stage(
        open_store(store_path),
        stage=stage,
        kind="painter",
        inputs=inputs | student.inputs,
        config={
            "training": config.to_dict(),
            "held_back": held_back,
            "num_processes": num_processes,
        },
        build=build,
    )


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
