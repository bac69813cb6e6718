"""The painter that a user named: its kind, its digest, and the painter in memory.

What names there are, `known_painters.py` says.
"""

import hashlib
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

from lidarpainter_models.errors import WeightsError
from lidarpainter_models.painter.known_painters import (
    BUNDLED_NANO,
    DIGEST_LENGTH,
    PAINTER_NAMES,
    PAINTERS,
    WEIGHTS_SUFFIX,
    PainterKind,
    is_model_name,
    split_preset,
)
from lidarpainter_models.storage.whole_files import sha256_of

if TYPE_CHECKING:  # a name is read without them: a command refuses a mistyped one at once
    import torch

    from lidarpainter_models.painter.protocol import Painter

_loaded: "dict[tuple[str, str, torch.dtype | None], Painter]" = {}
"""The painter that was loaded last, by its digest, device and precision."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PainterChoice:
    """A painter that was named; nothing of it is in memory before it is loaded."""

    name: str
    """As the user gave it."""
    kind: PainterKind
    """Whether it is a rule, and else which painter network it is."""

    @classmethod
    def of(cls, name_or_path: str | Path) -> "PainterChoice":
        """Read a name; whether its weights are there is seen when they are needed.

        Raises:
            WeightsError: it cannot be the name of a painter.
        """
        name = str(name_or_path)
        for row in PAINTERS:
            if row.name == name:
                return cls(name=name, kind=row.kind)
        if name.endswith(WEIGHTS_SUFFIX):
            from lidarpainter_models.painter.one_step.weights import is_trained_file

            return cls(name=name, kind="one-step" if is_trained_file(Path(name)) else "nano")
        if is_model_name(name):
            return cls(name=name, kind="one-step")
        raise WeightsError(
            f"no painter {name!r}: expected one of {', '.join(PAINTER_NAMES)}, a .safetensors file "
            "or a folder in diffusers' layout"
        )

    @property
    def files(self) -> list[Path]:
        """The files that it is made of; none for a rule.

        Raises:
            WeightsError: the model or the weights file is not there.
        """
        if self.kind == "rule":
            return []
        if self.kind == "nano":
            return [BUNDLED_NANO if self.name == "nano" else Path(self.name)]
        from lidarpainter_models.painter.one_step.loading import painter_files

        return painter_files(self.name)

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
        joined = "\n".join([split_preset(self.name)[1], *digests])
        return hashlib.sha256(joined.encode()).hexdigest()[:DIGEST_LENGTH]

    def load(self, device: "torch.device", precision: "torch.dtype | None" = None) -> "Painter":
        """The painter on a device; whoever asks for the same one again gets the one in memory.

        The default precision is the one that the device computes faster.

        Raises:
            WeightsError: weights are missing, damaged, or do not belong together.
            MissingPackageError: a one-step painter without the extra `diffusion`.
        """
        key = (self.digest, str(device), precision)
        if key not in _loaded:
            _loaded.clear()  # before the next is read: two of full size do not fit into memory
            _loaded[key] = self._new(device, precision)
        return _loaded[key]

    def _new(self, device: "torch.device", precision: "torch.dtype | None") -> "Painter":
        if self.kind == "rule":
            from lidarpainter_models.painter.baselines import RULES

            return RULES[self.name]()
        if self.kind == "nano":
            from lidarpainter_models.painter.nano.weights import load_weights

            return load_weights(self.files[0], device=device, precision=precision)
        from lidarpainter_models.painter.one_step.loading import load_one_step

        return load_one_step(self.name, device=device, dtype=precision)


def load_painter(name_or_path: str | Path, device: "torch.device | None" = None) -> "Painter":
    """The painter of a name; a one-step painter goes to the GPU if there is one and none is said.

    Raises:
        WeightsError: no such painter, or weights that cannot be used.
        MissingPackageError: a one-step painter without the extra `diffusion`.
    """
    choice = PainterChoice.of(name_or_path)
    if device is None:
        import torch

        has_gpu = choice.kind == "one-step" and torch.cuda.is_available()
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
    return sha256_of(path)
