"""Keep a running fit on disk, so that a killed run continues bit for bit.

One safetensors file holds every tensor; its header carries the numbers, as JSON. It is written
beside the old one and renamed over it, so that there is always one whole checkpoint or none.
"""

import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from torch import Tensor

from lidarpainter_models.errors import SceneError
from lidarpainter_models.storage.tensor_files import read_tensors, write_tensors

FILE_NAME = "fit.safetensors"


@dataclass(kw_only=True)
class CheckpointFolder:
    """Where and how often a fit is kept."""

    path: Path
    """A folder of this fit alone."""
    identity: str = ""
    """Names the fit (a digest of its inputs and settings); another fit's checkpoint is refused."""
    every_seconds: float = 30.0
    """Wall seconds between two checkpoints."""
    _last_time: float = field(default_factory=time.monotonic, repr=False)

    @property
    def is_due(self) -> bool:
        """Whether it is time for a checkpoint."""
        return time.monotonic() - self._last_time >= self.every_seconds

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
