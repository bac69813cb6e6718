"""The z-buffer of points with numba: every thread has one of its own for a run of the points.

Points of a run are visited in ascending order and only a strictly nearer one replaces another, in a
run as between runs, so ties go to the lower index and the number of threads changes nothing. Where
discs have many more pixels than the image, the nearest point of each radius is found in every pixel
first, and discs are drawn of these alone.
"""

import numba
import numpy as np
import torch
from torch import Tensor

LEAST_RUN = 1 << 16
"""Points for which another z-buffer is worth its memory."""
MOST_RADIUS_PX = 8
"""Of discs that are drawn of the nearest points alone."""
DENSE = 4.0
"""Pixels of all discs over those that the nearest points of each radius can have, from which on
they are."""


def splat_points(
    pixels_uv: Tensor, depth_m: Tensor, radius_px: Tensor, height_px: int, width_px: int
) -> Tensor:
    """Index of the nearest point in each pixel, or -1."""
    uv = pixels_uv.to(torch.float32).contiguous().numpy()  # what that rounds is in no image
    depth, radius = depth_m.contiguous().numpy(), radius_px.to(torch.int64).contiguous().numpy()
    size_px = (height_px, width_px)
    if len(depth) > height_px * width_px and radius.max() <= MOST_RADIUS_PX:
        counts = np.bincount(radius)
        discs = (2 * np.arange(len(counts)) + 1) ** 2
        if (counts * discs).sum() > DENSE * height_px * width_px * discs[counts > 0].sum():
            return torch.from_numpy(_splat_nearest(uv, depth, radius, size_px, len(counts) - 1))
    runs = min(numba.get_num_threads(), len(depth) // LEAST_RUN + 1)
    return torch.from_numpy(_splat(uv, depth, radius, size_px, runs))


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


@numba.njit(cache=True, nogil=True)
def _lay(nearest_m: np.ndarray, own: np.ndarray, best_m: np.ndarray, winner: np.ndarray) -> None:
    """Take the points of one image into another where they are nearer, or as near and earlier."""
    for row in range(best_m.shape[0]):
        for column in range(best_m.shape[1]):
            z, point = nearest_m[row, column], own[row, column]
            held_m = best_m[row, column]
            if z < held_m or (z == held_m < np.inf and point < winner[row, column]):
                best_m[row, column] = z
                winner[row, column] = point


@numba.njit(cache=True, nogil=True)
def _splat_nearest(
    pixels_uv: np.ndarray,
    depth_m: np.ndarray,
    radius_px: np.ndarray,
    size_px: tuple[int, int],
    reach: int,
) -> np.ndarray:
    """The same, by way of the nearest point of each radius in every pixel and around the image."""
    high, wide = size_px[0] + 2 * reach, size_px[1] + 2 * reach
    nearest_m = np.full((reach + 1, high, wide), np.inf, depth_m.dtype)
    own = np.full(nearest_m.shape, -1, np.int64)
    for point in range(len(depth_m)):
        z, r = depth_m[point], radius_px[point]
        u, v = np.floor(pixels_uv[point, 0]) + reach, np.floor(pixels_uv[point, 1]) + reach
        if 0 < z < np.inf and 0 <= u < wide and 0 <= v < high:
            row, column = np.int64(v), np.int64(u)
            if z < nearest_m[r, row, column]:
                nearest_m[r, row, column] = z
                own[r, row, column] = point
    best_m, winner = np.full(size_px, np.inf, depth_m.dtype), np.full(size_px, -1, np.int64)
    for step in range((2 * reach + 1) ** 2):
        down, across = step // (2 * reach + 1) - reach, step % (2 * reach + 1) - reach
        rows = slice(reach + down, reach + down + size_px[0])
        columns = slice(reach + across, reach + across + size_px[1])
        for r in range(reach + 1):
            if down * down + across * across <= r * (r + 1):
                _lay(nearest_m[r, rows, columns], own[r, rows, columns], best_m, winner)
    return winner
