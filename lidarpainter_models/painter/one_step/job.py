"""The one-step painter as a training job, in this process or in several.

It stands on a model that the user brings, or goes on from a weights file that names its model.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from lidarpainter_models.errors import ConfigError
from lidarpainter_models.metrics.lpips import load_lpips
from lidarpainter_models.metrics.lpips_files import LpipsFiles
from lidarpainter_models.painter.adversarial import FrozenFeatures
from lidarpainter_models.painter.examples import PairSource
from lidarpainter_models.painter.known_painters import DIGEST_LENGTH
from lidarpainter_models.painter.one_step.base_models import open_base
from lidarpainter_models.painter.one_step.loading import (
    SUFFIX,
    Trainable,
    load_trainable,
    split_preset,
)
from lidarpainter_models.painter.one_step.processes import run_in_processes
from lidarpainter_models.painter.one_step.training import (
    Judges,
    OneStepTrainee,
    OneStepTrainingConfig,
    train_one_step,
)
from lidarpainter_models.painter.one_step.weights import read_trained, save_trained
from lidarpainter_models.painter.selection import PainterChoice, file_digest
from lidarpainter_models.painter.training.job import started_from
from lidarpainter_models.painter.training.loop import Told
from lidarpainter_models.painter.training.processes import OneProcess, Processes

NO_FILES = LpipsFiles()


@dataclass(frozen=True, kw_only=True)
class OneStepRecipe:
    """What every process of a training has to know besides the pairs."""

    start: str
    """A model, or weights to go on from."""
    config: OneStepTrainingConfig
    lpips: LpipsFiles = NO_FILES

    def train(
        self,
        sources: Sequence[PairSource],
        folder: Path,
        *,
        device: torch.device,
        processes: Processes,
        told: Told | None = None,
    ) -> tuple[Trainable, dict[str, Any]]:
        """Train as one of some processes; returns the trained network and the record."""
        config = self.config
        made = load_trainable(
            self.start,
            config.network,
            prompts=config.prompts,
            dtype=torch.bfloat16 if config.half_precision else torch.float32,
            seed=config.seed,
        )
        judges = judges_of(self.lpips, device)
        trainee = OneStepTrainee(made.network.to(device), made.texts, config, judges)
        record = train_one_step(
            trainee, sources, checkpoint_folder=folder, progress=told, processes=processes
        )
        return made, record


def judges_of(files: LpipsFiles, device: torch.device) -> Judges:
    """LPIPS, and its backbone for the discriminator to look through, where there are weights.

    Raises:
        WeightsError: the files cannot be used.
    """
    lpips = load_lpips(files)
    if lpips is None:
        return Judges()
    lpips = lpips.to(device)
    features = FrozenFeatures(extract=lpips.features, channels=lpips.channels)
    return Judges(lpips=lpips.of_batch, features=features)


class OneStepJob:
    """See `TrainingJob`; its model is read when it trains."""

    name = "one-step"
    _made: Trainable

    def __init__(self, recipe: OneStepRecipe, device: torch.device, num_processes: int) -> None:
        """Take the recipe, the device, and how many processes train, each on a GPU of its own.

        Raises:
            ConfigError: the loss lacks what it weighs.
            WeightsError: the model or the first weights cannot be used.
        """
        files = recipe.lpips
        if files.missing and files != NO_FILES:
            raise ConfigError(files.missing)
        if files == NO_FILES:
            Judges().check(recipe.config.loss)  # before the model is read
        self._recipe = recipe
        self._device = device
        self._num_processes = num_processes
        self.first_provenance: Mapping[str, Any] | None = None
        if recipe.start.endswith(SUFFIX):
            self.first_provenance = read_trained(Path(recipe.start)).provenance
        else:
            open_base(split_preset(recipe.start)[0])

    @property
    def inputs(self) -> dict[str, str]:
        """See `TrainingJob`."""
        files = self._recipe.lpips
        found = {"model": PainterChoice.of(self._recipe.start).digest}
        for name, path in (("lpips backbone", files.backbone), ("lpips heads", files.heads)):
            if path is not None:
                found[name] = file_digest(path)[:DIGEST_LENGTH]
        return found

    @property
    def origin(self) -> dict[str, Any]:
        """See `TrainingJob`."""
        found = {"model": self._recipe.start, **self.inputs}
        return found | started_from(self.first_provenance)

    def train(self, sources: Sequence[PairSource], folder: Path, told: Told) -> dict[str, Any]:
        """See `TrainingJob`; several processes leave their last checkpoint, which is taken up here.

        Raises:
            ConfigError: fewer GPUs than processes, on a machine that has some.
            TrainingError: the loss is no longer finite, or a process has ended early.
        """
        count = self._num_processes
        if count > 1:
            run_in_processes(self._recipe, sources, folder, count, told)
        self._made, record = self._recipe.train(
            sources,
            folder,
            device=torch.device("cpu") if count > 1 else self._device,
            processes=OneProcess(count=count),
            told=told,
        )
        return record | {"base": self._made.base, "base_licence": self._made.licence}

    def licence(self, of_pairs: str) -> str:
        """See `TrainingJob`."""
        return f"that of the model underneath ({self._made.licence}), and {of_pairs}"

    def save(self, path: Path, *, licence: str, provenance: dict[str, Any]) -> None:
        """See `TrainingJob`."""
        save_trained(
            self._made.network,
            path,
            prompts=self._made.texts,
            base=self._made.base,
            mark=self._made.mark,
            licence=licence,
            provenance=provenance,
        )
