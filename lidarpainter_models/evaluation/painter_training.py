"""Train a painter on all but its validation split, and write down what it was trained on."""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

import lidarpainter_models
from lidarpainter_models.evaluation.held_back import (
    TARGETS_KEY,
    PairSubset,
    check_training_pairs,
    first_targets,
    hold_back,
)
from lidarpainter_models.metrics.lpips_files import LpipsFiles
from lidarpainter_models.painter.known_painters import WEIGHTS_SUFFIX
from lidarpainter_models.painter.one_step.job import NO_FILES
from lidarpainter_models.painter.training.job import TrainingJob
from lidarpainter_models.painter.training.loop import Told
from lidarpainter_models.painter.training_jobs import PainterTraining, job_for
from lidarpainter_models.readers.pandaset.reader import LICENCE as PANDASET_LICENCE
from lidarpainter_models.training_data.pairs import PairFolder, PairSet, open_sets

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
    """Where a painter is trained in one process."""
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

    def train(self, scratch: Path, output: Path, told: Told) -> tuple[Path, dict[str, Any]]:
        """Train with checkpoints in one folder; returns the weights, in the other, and the record.

        Raises:
            DataError: a pair has changed since it was written.
            TrainingError: the training cannot go on; its last checkpoint stays.
        """
        job = self.job()
        learnt, judged = self.split(job)
        folders = open_sets(self.sets).values()
        for folder in folders:
            folder.verify()
        trained = job.train(list(learnt.values()), scratch, told)
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
        weights = output / f"{job.name}{WEIGHTS_SUFFIX}"
        job.save(weights, licence=licence, provenance=provenance)
        return weights, record


def _provenance(record: dict[str, Any], learnt: Iterable[PairSubset]) -> dict[str, Any]:
    """What goes into the weights file: enough to know its origin and what must not judge it."""
    sets = list(learnt)
    kept = ("attribution", "training_digest", "num_pairs", "steps", "cpu_s", "seed", "torch")
    return {
        **{key: record[key] for key in (*kept, "software_version")},
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
