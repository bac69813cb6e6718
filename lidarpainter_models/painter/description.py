"""What a painter is, in numbers and words: its parts, its size and where it comes from."""

from typing import Any

from lidarpainter_models.painter.nano.painter import NanoPainter
from lidarpainter_models.painter.protocol import Painter

NO_LICENCE = "Apache-2.0, a rule of the package"


def describe_painter(painter: Painter) -> dict[str, Any]:
    """Architecture, parameters per part, licence and provenance as JSON types.

    A painter that learns nothing has no parameters, and its first sentence of documentation says
    what it does.
    """
    if not isinstance(painter, NanoPainter):
        summary = (type(painter).__doc__ or painter.name).strip().splitlines()[0]
        return {
            "name": painter.name,
            "architecture": {"summary": summary},
            "parameters": {},
            "num_parameters": 0,
            "licence": NO_LICENCE,
            "provenance": {},
        }
    parts = {
        name: sum(parameter.numel() for parameter in part.parameters())
        for name, part in painter.network.named_children()
    }
    config = painter.network.config
    provenance = dict(painter.provenance)
    return {
        "name": painter.name,
        "architecture": {
            "summary": "residual U-Net that mixes candidate pictures, plus a bounded residual",
            **config.to_dict(),
            "candidates": list(config.candidates),
        },
        "parameters": parts,
        "num_parameters": sum(parts.values()),
        "licence": provenance.pop("licence", None),
        "provenance": provenance,
    }
