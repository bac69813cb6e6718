"""One-step painters: they repair a rendered view with what was recorded around it."""

from lidarpainter_models.painter.baselines import OverlayPainter, UnpaintedPainter, WarpPainter
from lidarpainter_models.painter.protocol import (
    DEFAULT_PROMPT,
    Painter,
    Painting,
    PaintingConditions,
)
from lidarpainter_models.painter.selection import (
    BUNDLED_NANO,
    PAINTER_NAMES,
    PainterChoice,
    load_painter,
)

__all__ = [
    "BUNDLED_NANO",
    "DEFAULT_PROMPT",
    "PAINTER_NAMES",
    "OverlayPainter",
    "Painter",
    "PainterChoice",
    "Painting",
    "PaintingConditions",
    "UnpaintedPainter",
    "WarpPainter",
    "load_painter",
]
