"""A training job: a painter to be trained, what it stands on and what it leaves."""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from lidarpainter_models.painter.examples import PairSource
from lidarpainter_models.painter.training.loop import Told

ORIGIN = ("training_digest", "num_pairs", "steps", "cpu_s", "pairs", "licence", "started_from")
"""What a record keeps of the weights that its training went on from."""


class TrainingJob(ABC):
    """A painter that is to be trained; what it needs was checked, and is read when it trains."""

    name: str
    """Of its kind; its files are called so."""
    first_provenance: Mapping[str, Any] | None = None
    """Of the weights that it goes on from; None where it starts from nothing or a plain model."""

    @property
    @abstractmethod
    def inputs(self) -> dict[str, str]:
        """Digests of what it stands on besides the pairs."""

    @property
    def origin(self) -> dict[str, Any]:
        """What a record says of that; empty where it starts from nothing."""
        known = self.first_provenance
        if known is None:
            return {}
        return {"started_from": {key: known[key] for key in ORIGIN if key in known}}

    @abstractmethod
    def train(self, sources: Sequence[PairSource], folder: Path, told: Told) -> dict[str, Any]:
        """Train, with checkpoints in a folder; returns the record."""

    def licence(self, of_pairs: str) -> str:
        """Terms of the trained weights, given those of the pairs."""
        return of_pairs

    @abstractmethod
    def save(self, path: Path, *, licence: str, provenance: dict[str, Any]) -> None:
        """Write the trained weights."""
