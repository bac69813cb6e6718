"""Every painter that a name can stand for: one row each, which help and checks read.

The table needs no tensors, so that a command's help can show it; `selection.py` loads painters.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

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


def painter_help() -> str:
    """What the help of an option says of painters: every name with its meaning."""
    return "; ".join(f"{row.name} ({row.meaning})" for row in PAINTERS)


PAINTERS = (
    KnownPainter(name=NO_PAINTER, meaning="the render as it is", kind="rule"),
    KnownPainter(name="overlay", meaning="LiDAR colours laid over the render", kind="rule"),
    KnownPainter(name="warp", meaning="the mean of the render and recorded images", kind="rule"),
    KnownPainter(
        name="nano",
        meaning="the small painter network; a .safetensors file gives it other weights",
        kind="nano",
    ),
    KnownPainter(
        name="sd-turbo",
        meaning="the one-step painter network; also its .safetensors file or a model's folder",
        kind="one-step",
    ),
)
"""A rule is a row here and a class in `baselines.py`; how a network loads, `PainterChoice` says."""
PAINTER_NAMES = tuple(row.name for row in PAINTERS)
