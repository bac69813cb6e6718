"""Points into a z-buffer: millions of them, several cameras, growth."""

import numba
import torch
from bench_machine import best_cpu_s
from bench_raster import doublings
from bench_records import Figure
from bench_scenes import street_like_points

from lidarpainter_models.kernels.point_splat import splat_points, splat_views

POINT_GROWTH = (625_000, 1_250_000, 2_500_000, 5_000_000)
SIZE = (1024, 576)
CAMERAS = 3
POINT_BYTES = 2 * 8 + 4 + 8
PIXEL_BYTES = 8 + 4


def point_figures(machine, repeats, *, counts=POINT_GROWTH):
    """The largest number of points against its bytes, three cameras at once, and growth."""
    numba.set_num_threads(1)
    taken = {count: 1e3 * best_cpu_s(_splat_of(count), repeats) for count in counts}
    most = counts[-1]
    moved = most * POINT_BYTES + SIZE[0] * SIZE[1] * PIXEL_BYTES
    floor = 1e3 * moved / machine.bandwidth
    points = street_like_points(most, *SIZE)
    several = {
        name: value.expand(CAMERAS, *value.shape) if torch.is_tensor(value) else value
        for name, value in points.items()
    }
    cameras_ms = 1e3 * best_cpu_s(lambda: splat_views(**several, backend="cpu"), 1)
    return [
        Figure(name="point_splat.forward", value=taken[most], unit="ms", floor=floor),
        Figure(
            name=f"point_splat.{CAMERAS}_cameras",
            value=cameras_ms,
            unit="ms",
            floor=CAMERAS * floor,
        ),
        *doublings("growth.points", taken, "points"),
    ]


def _splat_of(count):
    points = street_like_points(count, *SIZE)
    return lambda: splat_points(**points, backend="cpu")
