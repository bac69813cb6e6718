"""What a painter is, in numbers and words: its parts, its size and where it comes from."""

import resource
import time
from dataclasses import dataclass
from statistics import median
from typing import Any

import torch

from lidarpainter_models.errors import ConfigError
from lidarpainter_models.painter.nano.painter import NanoPainter
from lidarpainter_models.painter.one_step.painter import OneStepPainter
from lidarpainter_models.painter.precision import type_name
from lidarpainter_models.painter.protocol import Painter, PaintingConditions

NUM_WARPS = 2


@dataclass(frozen=True, slots=True, kw_only=True)
class ViewTimes:
    """Medians of a view, and the most memory that the process has held so far."""

    cpu_ms: float
    """Of all threads."""
    wall_ms: float
    peak_memory_bytes: int


def time_views(painter: Painter, *, height_px: int, width_px: int, repeats: int) -> ViewTimes:
    """Paint one view again and again, once before it counts.

    Raises:
        ConfigError: the view has no pixels, or is never painted.
    """
    if min(height_px, width_px, repeats) < 1:
        raise ConfigError(f"expected pixels and repeats, got {width_px}x{height_px}, {repeats}")
    view = random_view(height_px, width_px)
    painter.paint(view)
    cpu_s, wall_s = [], []
    for _ in range(repeats):
        started_s, cpu_started_s = time.perf_counter(), time.process_time()
        painter.paint(view)
        cpu_s.append(time.process_time() - cpu_started_s)
        wall_s.append(time.perf_counter() - started_s)
    peak_kib = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return ViewTimes(
        cpu_ms=1e3 * median(cpu_s), wall_ms=1e3 * median(wall_s), peak_memory_bytes=peak_kib << 10
    )


def random_view(height_px: int, width_px: int, seed: int = 0) -> PaintingConditions:
    """A view of noise: a fifth of it with LiDAR, two thirds of it with warped images."""
    generator = torch.Generator().manual_seed(seed)

    def draw(*shape: int) -> torch.Tensor:
        return torch.rand(*shape, generator=generator)

    size_px = (height_px, width_px)
    return PaintingConditions(
        render_rgb=draw(*size_px, 3),
        render_depth_m=50 * draw(*size_px),
        render_alpha=draw(*size_px),
        lidar_rgb=draw(*size_px, 3),
        lidar_depth_m=50 * draw(*size_px),
        lidar_hit=draw(*size_px) < 0.2,
        warp_rgb=draw(NUM_WARPS, *size_px, 3),
        warp_valid=draw(NUM_WARPS, *size_px) < 0.67,
    )


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
