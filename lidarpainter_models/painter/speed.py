"""How long a painter takes for a view of random content, on whatever machine this is."""

import resource
import time
from dataclasses import dataclass
from statistics import median

import torch

from lidarpainter_models.errors import ConfigError
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
