"""Every painter that a name can stand for: one row each, which help, checks and loading read.

The table itself needs no tensors, so that a command's help can show it; a row imports its painter
when it is asked for its files or loaded.
"""

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    import torch

    from lidarpainter_models.painter.protocol import Painter

BUNDLED_NANO = Path(__file__).parent / "bundled" / "nano.safetensors"
"""Weights of the small painter network that come with the package."""
NO_PAINTER = "none"
WEIGHTS_SUFFIX = ".safetensors"
DIGEST_LENGTH = 32

PainterKind = Literal["rule", "nano", "one-step"]


@dataclass(frozen=True, slots=True, kw_only=True)
class KnownPainter:
    """A painter that can be named."""

    name: str
    meaning: str
    """What a help text says of it."""
    kind: PainterKind
    """`rule` for a painter that learns nothing, else which painter network it is."""
    accepts: Callable[[str], bool]
    """Whether a name of a user that is no name of the table stands for this painter."""
    files: Callable[[str], list[Path]]
    """The files that the painter of a name is made of; none for a rule."""
    digest: Callable[[str, Sequence[str]], str]
    """What a painting depends on besides the source, from the name and the SHA-256 of its files."""
    load: "Callable[[str, torch.device, torch.dtype | None], Painter]"
    """The painter of a name on a device; without a type in the one that the device does faster."""


def known_painter(name: str) -> KnownPainter | None:
    """The row of a painter's name, of its weights file or its model; None where there is none."""
    named = [row for row in PAINTERS if row.name == name]
    return next((row for row in (*named, *PAINTERS) if row in named or row.accepts(name)), None)


def painter_help() -> str:
    """What the help of an option says of painters: every name with its meaning."""
    return "; ".join(f"{row.name} ({row.meaning})" for row in PAINTERS)


def _rule(name: str, meaning: str, load: "Callable[[], Painter]") -> KnownPainter:
    return KnownPainter(
        name=name,
        meaning=meaning,
        kind="rule",
        accepts=lambda _name: False,
        files=lambda _name: [],
        digest=lambda name, _digests: name,
        load=lambda _name, _device, _precision: load(),
    )


def _load_unpainted() -> "Painter":
    from lidarpainter_models.painter.baselines import UnpaintedPainter

    return UnpaintedPainter()


def _load_overlay() -> "Painter":
    from lidarpainter_models.painter.baselines import OverlayPainter

    return OverlayPainter()


def _load_warp() -> "Painter":
    from lidarpainter_models.painter.baselines import WarpPainter

    return WarpPainter()


def _is_nano_file(name: str) -> bool:
    from lidarpainter_models.painter.one_step.weights import is_trained_file

    return name.endswith(WEIGHTS_SUFFIX) and not is_trained_file(Path(name))


def _nano_files(name: str) -> list[Path]:
    return [BUNDLED_NANO if name == "nano" else Path(name)]


def _load_nano(name: str, device: "torch.device", precision: "torch.dtype | None") -> "Painter":
    from lidarpainter_models.painter.nano.weights import load_weights

    return load_weights(_nano_files(name)[0], device=device, precision=precision)


def _is_one_step(name: str) -> bool:
    from lidarpainter_models.painter.one_step.loading import is_model_name
    from lidarpainter_models.painter.one_step.weights import is_trained_file

    return is_trained_file(Path(name)) if name.endswith(WEIGHTS_SUFFIX) else is_model_name(name)


def _one_step_files(name: str) -> list[Path]:
    from lidarpainter_models.painter.one_step.loading import painter_files

    return painter_files(name)


def _one_step_digest(name: str, digests: Sequence[str]) -> str:
    from lidarpainter_models.painter.one_step.loading import split_preset

    joined = "\n".join([split_preset(name)[1], *digests])
    return hashlib.sha256(joined.encode()).hexdigest()[:DIGEST_LENGTH]


def _load_one_step(name: str, device: "torch.device", precision: "torch.dtype | None") -> "Painter":
    from lidarpainter_models.painter.one_step.loading import load_one_step

    return load_one_step(name, device=device, dtype=precision)


PAINTERS = (
    _rule(NO_PAINTER, "the render as it is", _load_unpainted),
    _rule("overlay", "LiDAR colours laid over the render", _load_overlay),
    _rule("warp", "the mean of the render and recorded images", _load_warp),
    KnownPainter(
        name="nano",
        meaning="the small painter network; a .safetensors file gives it other weights",
        kind="nano",
        accepts=_is_nano_file,
        files=_nano_files,
        digest=lambda _name, digests: digests[0][:DIGEST_LENGTH],
        load=_load_nano,
    ),
    KnownPainter(
        name="sd-turbo",
        meaning="the one-step painter network; also its .safetensors file or a model's folder",
        kind="one-step",
        accepts=_is_one_step,
        files=_one_step_files,
        digest=_one_step_digest,
        load=_load_one_step,
    ),
)
"""A rule is a row here and a class in `baselines.py`; a network also says how its weights load."""
PAINTER_NAMES = tuple(row.name for row in PAINTERS)
