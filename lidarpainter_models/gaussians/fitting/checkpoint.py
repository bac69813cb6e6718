"""Keep a running fit on disk, so that a killed run continues bit for bit.

One safetensors file holds every tensor; its header carries the numbers, as JSON. It is written
beside the old one and renamed over it, so that there is always one whole checkpoint or none.
"""

import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from lidarpainter_models.errors import ConfigError, SceneError
from lidarpainter_models.storage.tensor_files import read_tensors, write_tensors

FILE_NAME = "fit.safetensors"


@dataclass(kw_only=True)
class CheckpointFolder:
    """Where and how often a fit is kept."""

    path: Path
    """A folder of this fit alone."""
    identity: str = ""
    """Names the fit (a digest of its inputs and settings); another fit's checkpoint is refused."""
    every_steps: int | None = None
    """Steps between two checkpoints, if given."""
    every_seconds: float | None = 30.0
    """Wall seconds between two checkpoints, if given."""
    _last_time: float = field(default_factory=time.monotonic, repr=False)

    def __post_init__(self) -> None:
        """Refuse a schedule without sense."""
        if self.every_steps is not None and self.every_steps < 1:
            raise ConfigError(f"every_steps must be positive, got {self.every_steps}")

    def is_due(self, step: int) -> bool:
        """Return whether a checkpoint should be written after this many steps."""
        if self.every_steps is not None and step % self.every_steps == 0:
            return True
        is_late = self.every_seconds is not None
        return is_late and time.monotonic() - self._last_time >= (self.every_seconds or 0.0)

    def save(self, tensors: dict[str, Tensor], numbers: dict[str, Any]) -> None:
        """Replace the checkpoint.

        Raises:
            WriteError: the file cannot be written.
        """
        header = {"identity": self.identity, "numbers": numbers}
        write_tensors(self.path / FILE_NAME, tensors, header)
        self._last_time = time.monotonic()

    def load(self) -> tuple[dict[str, Tensor], dict[str, Any]] | None:
        """Return the kept state, or None if there is none.

        Raises:
            SceneError: the checkpoint belongs to another fit or is damaged.
        """
        source = self.path / FILE_NAME
        if not source.exists():
            return None
        tensors, header = read_tensors(source, damaged=SceneError)
        if header.get("identity") != self.identity:
            raise SceneError(
                f"the checkpoint {source} belongs to another fit: remove it to start afresh"
            )
        return tensors, header["numbers"]


def group_tensors(groups: dict[str, dict[str, Tensor]]) -> dict[str, Tensor]:
    """Return one flat dictionary, names joined by a slash; every tensor gets memory of its own."""
    return {
        f"{group}/{name}": value.detach().clone()
        for group, tensors in groups.items()
        for name, value in tensors.items()
    }


def ungroup_tensors(tensors: dict[str, Tensor], group: str) -> dict[str, Tensor]:
    """Return the tensors of one group by their own names."""
    prefix = f"{group}/"
    return {
        name.removeprefix(prefix): value
        for name, value in tensors.items()
        if name.startswith(prefix)
    }


def generator_from(state: Tensor) -> torch.Generator:
    """Return a random generator in a kept state."""
    generator = torch.Generator()
    generator.set_state(state)
    return generator
