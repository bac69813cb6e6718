"""The z-buffer of points with numba: points are sorted into bands of rows, a band is one task.

Points of a band are visited in ascending order and only a strictly nearer one replaces another, so
ties go to the lower index and the number of threads changes nothing. A point is looked at once to
be sorted and once for each band its disc reaches, however many threads there are. Points are taken
piece by piece: room for millions at once would be new pages from the system at every call.
"""

import numba
import numpy as np
import torch
from torch import Tensor

BAND_ROWS = 32
"""Rows of a band: its z-buffer stays in the cache, and there are more bands than cores."""
PIECE = 1 << 20
"""Points taken at once: their sorted copies stay under the 32 MiB that allocators keep."""
RUNS = 16
"""Points of a piece are sorted in this many runs, whatever the number of threads."""


def splat_points(
    pixels_uv: Tensor, depth_m: Tensor, radius_px: Tensor, height_px: int, width_px: int
) -> Tensor:
    """Index of the nearest point in each pixel, or -1."""
    winner = _splat(
        pixels_uv.to(torch.int64).contiguous().numpy(),
        depth_m.contiguous().numpy(),
        radius_px.to(torch.int64).contiguous().numpy(),
        height_px,
        width_px,
    )
    return torch.from_numpy(winner)


@numba.njit(cache=True, inline="always")
def _bands_of(
    row: int, radius: int, column: int, depth_m: float, height_px: int, width_px: int
) -> tuple[int, int]:
    """First and one past the last band that a point's disc reaches; none for a point not seen."""
    if not (0 < depth_m < np.inf):
        return 0, 0
    if column + radius < 0 or column - radius >= width_px:
        return 0, 0
    first, end = max(row - radius, 0), min(row + radius + 1, height_px)
    if first >= end:
        return 0, 0
    return first // BAND_ROWS, (end - 1) // BAND_ROWS + 1


@numba.njit(cache=True)
def _starts(counts: np.ndarray) -> np.ndarray:
    """First entry of every band; `counts` becomes each run's first entry in each band."""
    runs, bands = counts.shape
    band_first = np.empty(bands + 1, np.int64)
    total = 0
    for band in range(bands):
        band_first[band] = total
        for run in range(runs):
            count = counts[run, band]
            counts[run, band] = total
            total += count
    band_first[bands] = total
    return band_first


@numba.njit(cache=True)
def _splat_band(
    discs: np.ndarray,
    depth_m: np.ndarray,
    rows: tuple[int, int],
    nearest_m: np.ndarray,
    winner: np.ndarray,
) -> None:
    """Draw the points of a band into its rows."""
    width_px = winner.shape[1]
    for place in range(len(depth_m)):
        z = depth_m[place]
        point, u, v, r = discs[place, 0], discs[place, 1], discs[place, 2], discs[place, 3]
        limit = np.int64(r) * (np.int64(r) + 1)
        for row in range(max(v - r, rows[0]), min(v + r + 1, rows[1])):
            rest = limit - (row - v) * (row - v)
            for column in range(max(u - r, 0), min(u + r + 1, width_px)):
                if (column - u) * (column - u) <= rest and z < nearest_m[row - rows[0], column]:
                    nearest_m[row - rows[0], column] = z
                    winner[row, column] = point


@numba.njit(cache=True, parallel=True)
def _splat_piece(
    pixels_uv: np.ndarray,
    depth_m: np.ndarray,
    radius_px: np.ndarray,
    piece: tuple[int, int],
    nearest_m: np.ndarray,
    winner: np.ndarray,
) -> None:
    """Draw the points of one piece, given by its first and the one past its last."""
    height_px, width_px = winner.shape
    start, count = piece[0], piece[1] - piece[0]
    bands = (height_px + BAND_ROWS - 1) // BAND_ROWS
    counts = np.zeros((RUNS, bands), np.int64)
    for run in numba.prange(RUNS):
        for point in range(start + run * count // RUNS, start + (run + 1) * count // RUNS):
            u, v, r = pixels_uv[point, 0], pixels_uv[point, 1], radius_px[point]
            first, end = _bands_of(v, r, u, depth_m[point], height_px, width_px)
            for band in range(first, end):
                counts[run, band] += 1
    band_first = _starts(counts)
    # what a band needs lies side by side, or each band would drag all points through the cache
    discs, depths_m = (
        np.empty((band_first[-1], 4), np.int32),
        np.empty(band_first[-1], depth_m.dtype),
    )
    for run in numba.prange(RUNS):
        for point in range(start + run * count // RUNS, start + (run + 1) * count // RUNS):
            u, v, r = pixels_uv[point, 0], pixels_uv[point, 1], radius_px[point]
            first, end = _bands_of(v, r, u, depth_m[point], height_px, width_px)
            for band in range(first, end):
                place = counts[run, band]
                counts[run, band] += 1
                discs[place, 0], discs[place, 1], discs[place, 2] = point, u, v
                discs[place, 3] = r
                depths_m[place] = depth_m[point]
    for band in numba.prange(bands):
        rows = (band * BAND_ROWS, min((band + 1) * BAND_ROWS, height_px))
        first, end = band_first[band], band_first[band + 1]
        own_m = nearest_m[rows[0] : rows[1]]
        _splat_band(discs[first:end], depths_m[first:end], rows, own_m, winner)


@numba.njit(cache=True)
def _splat(
    pixels_uv: np.ndarray,
    depth_m: np.ndarray,
    radius_px: np.ndarray,
    height_px: int,
    width_px: int,
) -> np.ndarray:
    winner = np.full((height_px, width_px), -1, dtype=np.int64)
    nearest_m = np.full((height_px, width_px), np.inf, dtype=depth_m.dtype)
    for first in range(0, len(depth_m), PIECE):
        piece = (first, min(first + PIECE, len(depth_m)))
        _splat_piece(pixels_uv, depth_m, radius_px, piece, nearest_m, winner)
    return winner
