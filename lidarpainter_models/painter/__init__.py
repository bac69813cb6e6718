"""One-step painters: they repair a rendered view with what was recorded around it."""

from pathlib import Path

import torch

from lidarpainter_models.errors import WeightsError
from lidarpainter_models.painter.baselines import OverlayPainter, UnpaintedPainter, WarpPainter
from lidarpainter_models.painter.nano.weights import load_weights
from lidarpainter_models.painter.one_step.base_models import SD_TURBO
from lidarpainter_models.painter.one_step.loading import is_model_name, load_one_step
from lidarpainter_models.painter.one_step.weights import is_trained_file
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
    "is_one_step",
    "load_painter",
]

BUNDLED_NANO = Path(__file__).parent / "bundled" / "nano.safetensors"
"""Weights of the small painter that come with the package."""

_UNLEARNED = {painter.name: painter for painter in (UnpaintedPainter, OverlayPainter, WarpPainter)}
PAINTER_NAMES = (*_UNLEARNED, "nano", SD_TURBO)


def load_painter(name_or_path: str | Path) -> Painter:
    """A painter by its name, from a `.safetensors` file, or from a model in diffusers' layout.

    A one-step painter goes to the GPU if there is one; its paintings come back to their conditions.

    Raises:
        WeightsError: no such painter, or weights that cannot be used.
        MissingPackageError: a one-step painter without the extra `diffusion`.
    """
    name = str(name_or_path)
    if name in _UNLEARNED:
        return _UNLEARNED[name]()
    if name == "nano":
        return load_weights(BUNDLED_NANO)
    if is_one_step(name):
        painter = load_one_step(name)
        return painter.to(torch.device("cuda")) if torch.cuda.is_available() else painter
    if name.endswith(".safetensors"):
        return load_weights(Path(name))
    raise WeightsError(
        f"no painter {name!r}: expected one of {', '.join(PAINTER_NAMES)}, a .safetensors file or "
        "a folder in diffusers' layout"
    )


def is_one_step(name: str) -> bool:
    """Whether a name stands for a one-step painter: a weights file of one, or a model."""
    if name.endswith(".safetensors"):
        return is_trained_file(Path(name))
    return is_model_name(name)
