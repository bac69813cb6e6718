"""The one-step painter as a training job, in this process or in several.

It stands on a model that the user brings, or goes on from a weights file that names its model.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch

from lidarpainter_models.errors import ConfigError
from lidarpainter_models.metrics.lpips import load_lpips
from lidarpainter_models.metrics.lpips_files import LpipsFiles
from lidarpainter_models.painter.adversarial import FrozenFeatures
from lidarpainter_models.painter.examples import PairSource
from lidarpainter_models.painter.known_painters import DIGEST_LENGTH, WEIGHTS_SUFFIX, split_preset
from lidarpainter_models.painter.one_step.base_models import open_base
from lidarpainter_models.painter.one_step.loading import load_trainable
from lidarpainter_models.painter.one_step.processes import run_in_processes
from lidarpainter_models.painter.one_step.training import (
    Judges,
    OneStepTrainee,
    OneStepTrainingConfig,
    train_one_step,
)
from lidarpainter_models.painter.one_step.weights import Trainable, read_trained, save_trained
from lidarpainter_models.painter.selection import PainterChoice, file_digest
from lidarpainter_models.painter.training.job import TrainingJob
from lidarpainter_models.painter.training.loop import Told
from lidarpainter_models.painter.training.processes import Processes

CPU = torch.device("cpu")
NO_FILES = LpipsFiles()


class OneStepJob(TrainingJob):
    """Its model is read when it trains; every process of a training has a copy of it."""

    name = "one-step"
    _made: Trainable

    def __init__(
        self,
        start: str,
        config: OneStepTrainingConfig,
        lpips: LpipsFiles = NO_FILES,
        *,
        device: torch.device = CPU,
        num_processes: int = 1,
    ) -> None:
        """Take a model, or weights to go on from, the recipe, and what the loss looks through.

        Several processes train each on a GPU of its own, one on the device.

        Raises:
            ConfigError: the loss lacks what it weighs.
            WeightsError: the model or the first weights cannot be used.
        """
        if lpips.missing and lpips != NO_FILES:
            raise ConfigError(lpips.missing)
        if lpips == NO_FILES:
            Judges().check(config.loss)  # before the model is read
        self._start, self._config, self._lpips = start, config, lpips
        self._device, self._num_processes = device, num_processes
        if start.endswith(WEIGHTS_SUFFIX):
            self.first_provenance = read_trained(Path(start)).provenance
        else:
            open_base(split_preset(start)[0])

    @property
    def inputs(self) -> dict[str, str]:
        """See `TrainingJob`."""
        found = {"model": PainterChoice.of(self._start).digest}
        for name, path in self._lpips.named.items():
            found[name] = file_digest(path)[:DIGEST_LENGTH]
        return found

    @property
    def origin(self) -> dict[str, Any]:
        """See `TrainingJob`."""
        return self.inputs | super().origin

    def train(self, sources: Sequence[PairSource], folder: Path, told: Told) -> dict[str, Any]:
        """See `TrainingJob`; several processes leave their last checkpoint, which is taken up here.

        Raises:
            ConfigError: fewer GPUs than processes, on a machine that has some.
            TrainingError: the loss is no longer finite, or a process has ended early.
        """
        count = self._num_processes
        if count > 1:
            run_in_processes(self, sources, folder, count, told)
        device = CPU if count > 1 else self._device
        record = self.train_as_one(
            sources, folder, device=device, processes=Processes(count), told=told
        )
        return record | {"base": self._made.base, "base_licence": self._made.licence}

    def train_as_one(
        self,
        sources: Sequence[PairSource],
        folder: Path,
        *,
        device: torch.device,
        processes: Processes,
        told: Told | None = None,
    ) -> dict[str, Any]:
        """Train as one of some processes; returns the record."""
        config = self._config
        self._made = load_trainable(
            self._start,
            config.network,
            prompts=config.prompts,
            dtype=torch.bfloat16 if config.half_precision else torch.float32,
            seed=config.seed,
        )
        network = self._made.network.to(device)
        trainee = OneStepTrainee(network, self._made.texts, config, self._judges(device))
        return train_one_step(
            trainee, sources, checkpoint_folder=folder, progress=told, processes=processes
        )

    def _judges(self, device: torch.device) -> Judges:
        """LPIPS, and its backbone for the discriminator to look through, if there are weights."""
        lpips = load_lpips(self._lpips)
        if lpips is None:
            return Judges()
        lpips = lpips.to(device)
        features = FrozenFeatures(extract=lpips.features, channels=lpips.channels)
        return Judges(lpips=lpips.of_batch, features=features)

    def licence(self, of_pairs: str) -> str:
        """See `TrainingJob`."""
        return f"that of the model underneath ({self._made.licence}), and {of_pairs}"

    def save(self, path: Path, *, licence: str, provenance: dict[str, Any]) -> None:
        """See `TrainingJob`."""
        save_trained(self._made, path, licence=licence, provenance=provenance)
