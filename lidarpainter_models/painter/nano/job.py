"""The small painter as a training job: it starts from nothing, or goes on from weights."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch

from lidarpainter_models.painter.examples import PairSource
from lidarpainter_models.painter.known_painters import DIGEST_LENGTH
from lidarpainter_models.painter.nano.painter import NanoPainter
from lidarpainter_models.painter.nano.training import NanoTrainingConfig, train_nano
from lidarpainter_models.painter.nano.weights import save_weights
from lidarpainter_models.painter.training.checkpoints import training_digest
from lidarpainter_models.painter.training.job import started_from
from lidarpainter_models.painter.training.loop import Told


class NanoJob:
    """See `TrainingJob`."""

    name = "nano"

    def __init__(
        self, config: NanoTrainingConfig, first: NanoPainter | None, device: torch.device
    ) -> None:
        """Take the recipe, the painter to go on from, and where to train."""
        self._config, self._device = config, device
        self._start = None if first is None else first.network
        self._trained = self._start
        self.first_provenance: Mapping[str, Any] | None = None
        if first is not None:
            self.first_provenance = first.provenance

    @property
    def inputs(self) -> dict[str, str]:
        """See `TrainingJob`."""
        if self._start is None:
            return {}
        known = training_digest({}, [], self._start.state_dict())
        return {"first weights": known[:DIGEST_LENGTH]}

    @property
    def origin(self) -> dict[str, Any]:
        """See `TrainingJob`."""
        return started_from(self.first_provenance)

    def train(self, sources: Sequence[PairSource], folder: Path, told: Told) -> dict[str, Any]:
        """See `TrainingJob`."""
        result = train_nano(
            sources,
            self._config,
            start=self._start,
            checkpoint_folder=folder,
            progress=told,
            device=self._device,
        )
        self._trained = result.network
        return result.record

    def licence(self, of_pairs: str) -> str:
        """See `TrainingJob`."""
        return of_pairs

    def save(self, path: Path, *, licence: str, provenance: dict[str, Any]) -> None:
        """See `TrainingJob`."""
        assert self._trained is not None, "train before saving"  # noqa: S101
        save_weights(self._trained, path, licence=licence, provenance=provenance)
