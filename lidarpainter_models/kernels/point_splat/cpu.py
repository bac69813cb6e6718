"""The z-buffer of points with numba: every thread has one of its own for a run of the points.

Points of a run are visited in ascending order and only a strictly nearer one replaces another, in a
run as between runs, so ties go to the lower index and the number of threads changes nothing.
"""

import numba
import numpy as np
import torch
from torch import Tensor

LEAST_RUN = 1 << 16
"""Points for which another z-buffer is worth its memory."""


def splat_points(
    pixels_uv: Tensor, depth_m: Tensor, radius_px: Tensor, height_px: int, width_px: int
) -> Tensor:
    """Index of the nearest point in each pixel, or -1."""
    winner = _splat(
        pixels_uv.to(torch.float32).contiguous().numpy(),  # what that rounds is in no image
        depth_m.contiguous().numpy(),
        radius_px.to(torch.int64).contiguous().numpy(),
        (height_px, width_px),
        min(numba.get_num_threads(), len(depth_m) // LEAST_RUN + 1),
    )
    return torch.from_numpy(winner)


@numba.njit(cache=True, nogil=True)
def _draw(
    pixels_uv: np.ndarray,
    depth_m: np.ndarray,
    radius_px: np.ndarray,
    points: tuple[int, int],
    nearest_m: np.ndarray,
    winner: np.ndarray,
) -> None:
    """Draw the points of one run, given by its first and the one past its last."""
    height_px, width_px = winner.shape
    for point in range(points[0], points[1]):
        z, r = depth_m[point], radius_px[point]
        if not (0 < z < np.inf):
            continue
        u = np.int64(np.floor(pixels_uv[point, 0]))
        v = np.int64(np.floor(pixels_uv[point, 1]))
        limit = r * (r + 1)
        for row in range(max(v - r, 0), min(v + r + 1, height_px)):
            rest = limit - (row - v) * (row - v)
            for column in range(max(u - r, 0), min(u + r + 1, width_px)):
                if z < nearest_m[row, column] and (column - u) * (column - u) <= rest:
                    nearest_m[row, column] = z
                    winner[row, column] = point


@numba.njit(cache=True, nogil=True, parallel=True)
def _splat(
    pixels_uv: np.ndarray,
    depth_m: np.ndarray,
    radius_px: np.ndarray,
    size_px: tuple[int, int],
    runs: int,
) -> np.ndarray:
    count = len(depth_m)
    nearest_m = np.full((runs, *size_px), np.inf, dtype=depth_m.dtype)
    winner = np.full((runs, *size_px), -1, dtype=np.int64)
    for run in numba.prange(runs):
        points = (run * count // runs, (run + 1) * count // runs)
        _draw(pixels_uv, depth_m, radius_px, points, nearest_m[run], winner[run])
    for row in numba.prange(size_px[0]):
        for run in range(1, runs):
            for column in range(size_px[1]):
                if nearest_m[run, row, column] < nearest_m[0, row, column]:
                    nearest_m[0, row, column] = nearest_m[run, row, column]
                    winner[0, row, column] = winner[run, row, column]
    return winner[0]
