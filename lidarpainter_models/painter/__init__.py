"""One-step painters: they repair a rendered view with what was recorded around it."""

from pathlib import Path

from lidarpainter_models.errors import WeightsError
from lidarpainter_models.painter.baselines import OverlayPainter, UnpaintedPainter, WarpPainter
from lidarpainter_models.painter.nano.weights import load_weights
from lidarpainter_models.painter.protocol import (
    DEFAULT_PROMPT,
    Painter,
    Painting,
    PaintingConditions,
)

__all__ = [
    "BUNDLED_NANO",
    "DEFAULT_PROMPT",
    "PAINTER_NAMES",
    "OverlayPainter",
    "Painter",
    "Painting",
    "PaintingConditions",
    "UnpaintedPainter",
    "WarpPainter",
    "load_painter",
]

BUNDLED_NANO = Path(__file__).parent / "bundled" / "nano.safetensors"
"""Weights of the small painter that come with the package."""

_UNLEARNED = {painter.name: painter for painter in (UnpaintedPainter, OverlayPainter, WarpPainter)}
PAINTER_NAMES = (*_UNLEARNED, "nano")


def load_painter(name_or_path: str | Path) -> Painter:
    """A painter by its name, or the small painter with weights from a `.safetensors` file.

    Raises:
        WeightsError: no such painter, or a weights file that cannot be used.
    """
    name = str(name_or_path)
    if name in _UNLEARNED:
        return _UNLEARNED[name]()
    if name == "nano":
        return load_weights(BUNDLED_NANO)
    if name.endswith(".safetensors"):
        return load_weights(Path(name))
    raise WeightsError(
        f"no painter {name!r}: expected one of {', '.join(PAINTER_NAMES)} or a .safetensors file"
    )
