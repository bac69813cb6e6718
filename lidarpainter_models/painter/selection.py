"""What a painter's name stands for, what its digest is, and how it is loaded: read here alone.

A painter is named as a rule (`none`, `overlay`, `warp`), as `nano`, by the `.safetensors` file of
either learned painter, or by a model in diffusers' layout with a preset after a colon.
"""

import hashlib
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Literal

import torch

from lidarpainter_models.errors import WeightsError
from lidarpainter_models.painter.baselines import OverlayPainter, UnpaintedPainter, WarpPainter
from lidarpainter_models.painter.nano.weights import load_weights
from lidarpainter_models.painter.one_step.base_models import SD_TURBO
from lidarpainter_models.painter.one_step.loading import (
    is_model_name,
    load_one_step,
    painter_files,
    split_preset,
)
from lidarpainter_models.painter.one_step.weights import is_trained_file
from lidarpainter_models.painter.protocol import Painter

BUNDLED_NANO = Path(__file__).parent / "bundled" / "nano.safetensors"
"""Weights of the small painter that come with the package."""
NO_PAINTER = UnpaintedPainter.name
RULES = {painter.name: painter for painter in (UnpaintedPainter, OverlayPainter, WarpPainter)}
"""Painters that learn nothing."""
NANO = "nano"
PAINTER_NAMES = (*RULES, NANO, SD_TURBO)
WEIGHTS_SUFFIX = ".safetensors"
DIGEST_LENGTH = 32

Kind = Literal["rule", "nano", "one-step"]

_loaded: dict[tuple[str, str, torch.dtype | None], Painter] = {}
"""The painter that was loaded last, by its digest, device and precision."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PainterChoice:
    """A painter that was named; nothing of it is in memory before it is loaded."""

    name: str
    """As the user gave it."""
    kind: Kind

    @classmethod
    def of(cls, name_or_path: str | Path) -> "PainterChoice":
        """Read a name; whether its weights are there is seen when they are needed.

        Raises:
            WeightsError: it cannot be the name of a painter.
        """
        name = str(name_or_path)
        if name in RULES:
            return cls(name=name, kind="rule")
        is_file = name.endswith(WEIGHTS_SUFFIX)
        if is_trained_file(Path(name)) if is_file else is_model_name(name):
            return cls(name=name, kind="one-step")
        if name == NANO or is_file:
            return cls(name=name, kind="nano")
        raise WeightsError(
            f"no painter {name!r}: expected one of {', '.join(PAINTER_NAMES)}, a .safetensors file "
            "or a folder in diffusers' layout"
        )

    @property
    def is_one_step(self) -> bool:
        """Whether it is a diffusion model."""
        return self.kind == "one-step"

    @property
    def files(self) -> list[Path]:
        """What it is made of; nothing for a rule.

        Raises:
            WeightsError: a model is not there.
        """
        if self.kind == "one-step":
            return painter_files(self.name)
        if self.kind == "rule":
            return []
        return [BUNDLED_NANO if self.name == NANO else Path(self.name)]

    @property
    def digest(self) -> str:
        """What a painting depends on besides the source: bytes of the weights, wherever they lie.

        A rule's is its name.

        Raises:
            WeightsError: the weights are missing.
        """
        if self.kind == "rule":
            return self.name
        digests = [file_digest(path) for path in self.files]
        if self.kind == "nano":
            return digests[0][:DIGEST_LENGTH]
        _, preset = split_preset(self.name)
        joined = "\n".join([preset, *digests])
        return hashlib.sha256(joined.encode()).hexdigest()[:DIGEST_LENGTH]

    def load(self, device: torch.device, precision: torch.dtype | None = None) -> Painter:
        """The painter; whoever asks for the same one again gets the one that is in memory.

        The default precision is the one that the device computes faster.

        Raises:
            WeightsError: weights are missing, damaged, or do not belong together.
            MissingPackageError: a one-step painter without the extra `diffusion`.
        """
        key = (self.digest, str(device), precision)
        if key not in _loaded:
            _loaded.clear()  # before the next is read: two of full size do not fit into memory
            _loaded[key] = self._read(device, precision)
        return _loaded[key]

    def _read(self, device: torch.device, precision: torch.dtype | None) -> Painter:
        if self.kind == "rule":
            return RULES[self.name]()
        if self.kind == "nano":
            return load_weights(self.files[0], device=device, precision=precision)
        return load_one_step(self.name, device=device, dtype=precision)


def load_painter(name_or_path: str | Path, device: torch.device | None = None) -> Painter:
    """The painter of a name; a one-step painter goes to the GPU if there is one and none is said.

    Raises:
        WeightsError: no such painter, or weights that cannot be used.
        MissingPackageError: a one-step painter without the extra `diffusion`.
    """
    choice = PainterChoice.of(name_or_path)
    if device is None:
        has_gpu = choice.is_one_step and torch.cuda.is_available()
        device = torch.device("cuda" if has_gpu else "cpu")
    return choice.load(device)


def file_digest(path: Path) -> str:
    """SHA-256 of a weights file; 64 hexadecimal digits.

    Raises:
        WeightsError: it is not there.
    """
    try:
        found = path.stat()
        return _remembered_digest(path.absolute(), found.st_size, found.st_mtime_ns)
    except OSError as error:
        raise WeightsError(f"no painter weights at {path}: {error.strerror}") from None


@lru_cache(maxsize=64)
def _remembered_digest(path: Path, size: int, changed_ns: int) -> str:  # noqa: ARG001 - the key
    """Read again only once the file, perhaps of gigabytes, has changed."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
