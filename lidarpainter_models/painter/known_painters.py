"""Every painter that a name can stand for: one row each, which help and checks read.

The table needs no tensors, so that a command's help can show it; `selection.py` loads painters.
"""

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

BUNDLED_NANO = Path(__file__).parent / "bundled" / "nano.safetensors"
"""Weights of the small painter network that come with the package."""
NO_PAINTER = "none"
WEIGHTS_SUFFIX = ".safetensors"
DIGEST_LENGTH = 32
SD_TURBO = "sd-turbo"
WIRINGS = ("paper", "as-shipped", "fast", "with-reference")
"""Presets of the one-step painter, in `one_step/config.py`; one stands after a model's colon."""
_HUB_ID = re.compile(r"[A-Za-z0-9][\w.-]*/[A-Za-z0-9][\w.-]*")

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
        name=SD_TURBO,
        meaning="the one-step painter network; also its .safetensors file or a model's folder",
        kind="one-step",
    ),
)
"""A rule is a row here and a class in `baselines.py`; how a network loads, `PainterChoice` says."""
PAINTER_NAMES = tuple(row.name for row in PAINTERS)


def is_model_name(name: str) -> bool:
    """Whether a name may stand for a model: `sd-turbo`, a folder, an id of the hub."""
    model, _ = split_preset(name)
    return model == SD_TURBO or Path(model).is_dir() or is_hub_id(model)


def is_hub_id(name: str) -> bool:
    """Whether a name reads `owner/model`."""
    return _HUB_ID.fullmatch(name) is not None


def split_preset(name: str) -> tuple[str, str]:
    """A model and the preset after its last colon, `paper` without one."""
    model, _, preset = name.rpartition(":")
    return (model, preset) if model and preset in WIRINGS else (name, "paper")
