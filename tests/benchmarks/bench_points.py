"""Points into a z-buffer: millions of them, growth."""

import numba
from bench_machine import best_cpu_s
from bench_raster import doublings
from bench_records import Figure
from bench_scenes import street_like_points

from lidarpainter_models.kernels.point_splat import splat_points

POINT_GROWTH = (625_000, 1_250_000, 2_500_000, 5_000_000)
SIZE = (1024, 576)
POINT_BYTES = 2 * 8 + 4 + 8
PIXEL_BYTES = 8 + 4


def point_figures(machine, repeats, *, counts=POINT_GROWTH):
    """The largest number of points against its bytes, and growth."""
    numba.set_num_threads(1)
    taken = {count: 1e3 * best_cpu_s(_splat_of(count), repeats) for count in counts}
    most = counts[-1]
    moved = most * POINT_BYTES + SIZE[0] * SIZE[1] * PIXEL_BYTES
    floor = 1e3 * moved / machine.bandwidth
    return [
        Figure(name="point_splat.forward", value=taken[most], unit="ms", floor=floor),
        *doublings("growth.points", taken, "points"),
    ]


def _splat_of(count):
    points = street_like_points(count, *SIZE)
    return lambda: splat_points(**points, backend="cpu")
