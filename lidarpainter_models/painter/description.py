"""What a painter is, in numbers and words: its parts, its size and where it comes from."""

from typing import Any

from lidarpainter_models.painter.nano.painter import NanoPainter
from lidarpainter_models.painter.one_step.painter import OneStepPainter
from lidarpainter_models.painter.precision import type_name
from lidarpainter_models.painter.protocol import Painter

NO_LICENCE = "Apache-2.0, a rule of the package"


def describe_painter(painter: Painter) -> dict[str, Any]:
    """Architecture, parameters per part, licence and provenance as JSON types.

    A painter that learns nothing has no parameters, and its first sentence of documentation says
    what it does.
    """
    if isinstance(painter, NanoPainter):
        config = painter.network.config
        architecture = {
            "summary": "residual U-Net that mixes candidate images, plus a bounded residual",
            **config.to_dict(),
            "candidates": list(config.candidates),
        }
        return _learned(painter, architecture)
    if isinstance(painter, OneStepPainter):
        architecture = {
            "summary": "one step of a latent diffusion model, guided by LiDAR",
            **painter.network.config.to_dict(),
        }
        return _learned(painter, architecture)
    summary = (type(painter).__doc__ or painter.name).strip().splitlines()[0]
    return {
        "name": painter.name,
        "architecture": {"summary": summary},
        "parameters": {},
        "num_parameters": 0,
        "licence": NO_LICENCE,
        "provenance": {},
    }


def _learned(painter: NanoPainter | OneStepPainter, architecture: dict[str, Any]) -> dict[str, Any]:
    parts = {
        part: sum(parameter.numel() for parameter in module.parameters())
        for part, module in painter.network.named_children()
    }
    rest = dict(painter.provenance)
    return {
        "name": painter.name,
        "precision": type_name(painter.precision),
        "architecture": architecture,
        "parameters": parts,
        "num_parameters": sum(parts.values()),
        "licence": rest.pop("licence", None),
        "provenance": rest,
    }
