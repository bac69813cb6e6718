"""Sort visible Gaussians by depth and list, for every screen tile, those that reach it.

A Gaussian is listed in a tile only if its ellipse alpha >= 1/255 crosses the tile's pixel centres
row band by row band ("AccuTile" of Hanson et al. 2025, "Speedy-Splat"). The lists are filled in
depth order by counting, so they need no sort of their own. Compiled code.
"""

import math
from typing import NamedTuple

import numba
import numpy as np

from lidarpainter_models.kernels.gaussian_raster.blending_limits import TILE_PX
from lidarpainter_models.kernels.gaussian_raster.compilation import EXACT, compiled_entry
from lidarpainter_models.kernels.gaussian_raster.projection import (
    ACROSS,
    ALONG,
    DEPTH,
    HALF_HEIGHT,
    HALF_WIDTH,
    IS_VISIBLE,
    MEAN_X,
    MEAN_X_FRACTION,
    MEAN_Y,
    MEAN_Y_FRACTION,
    SHEAR,
)
from lidarpainter_models.kernels.gaussian_raster.work_sharing import jump_of

RUNS = 16
"""The depth order is cut into this many runs that are listed independently of each other."""
RADIX_BITS = 11
ROUNDING_PX = 1e-3
"""Slack of the ellipse test; what it lets in too much fails the exact test of the pixel."""


class TileLists(NamedTuple):
    """Which Gaussians reach which tile, and where each Gaussian's entries lie."""

    columns: int
    rows: int
    tile_first: np.ndarray
    """(tiles + 1): entries of tile t are `tile_first[t] : tile_first[t + 1]`, nearest first."""
    gaussian: np.ndarray
    """(entries): index of the Gaussian."""
    order: np.ndarray
    """(visible): indices of the visible Gaussians, nearest first."""
    entry_first: np.ndarray
    """(visible + 1): where the entries of the Gaussian at a place in `order` begin in `entry`."""
    entry: np.ndarray
    """(entries): numbers of the entries, Gaussian by Gaussian, tiles in reading order."""


@numba.njit(**EXACT)
def depth_order(records: np.ndarray) -> np.ndarray:
    """Indices of the visible Gaussians by depth; equal depths keep the order of their index."""
    count = 0
    for index in range(len(records)):
        count += records[index, IS_VISIBLE] > 0.0
    order = np.empty(count, np.int32)
    depth = np.empty(count, np.float32)
    place = 0
    for index in range(len(records)):
        if records[index, IS_VISIBLE] > 0.0:
            order[place] = index
            depth[place] = records[index, DEPTH]
            place += 1
    # positive floats sort as their bit patterns do
    return _radix_sorted(depth.view(np.uint32), order)


@numba.njit(**EXACT)
def _radix_sorted(keys: np.ndarray, order: np.ndarray) -> np.ndarray:
    digits = 1 << RADIX_BITS
    mask = np.uint32(digits - 1)
    other_keys, other_order = np.empty_like(keys), np.empty_like(order)
    for shift in range(0, 32, RADIX_BITS):
        starts = np.zeros(digits + 1, np.int64)
        for key in keys:
            starts[((key >> np.uint32(shift)) & mask) + 1] += 1
        for digit in range(digits):
            starts[digit + 1] += starts[digit]
        for place in range(len(keys)):
            digit = (keys[place] >> np.uint32(shift)) & mask
            target = starts[digit]
            starts[digit] += 1
            other_keys[target] = keys[place]
            other_order[target] = order[place]
        keys, other_keys = other_keys, keys
        order, other_order = other_order, order
    return order


@numba.njit(**EXACT)
def _tile_span(low_px: float, high_px: float, tiles: int) -> tuple[int, int]:
    """First and one past the last tile whose pixel centres lie between two positions."""
    first = math.ceil(max(low_px - ROUNDING_PX, 0.0) - 0.5)
    last = math.floor(min(high_px + ROUNDING_PX, tiles * TILE_PX + 0.0) - 0.5)
    return int(first) // TILE_PX, min(int(last) // TILE_PX + 1, tiles)


@numba.njit(**EXACT)
def _reach_across(record: np.ndarray, y_low: float, y_high: float) -> tuple[float, float]:
    """Leftmost and rightmost offset from the centre of the ellipse between two row offsets."""
    half_height = np.float64(record[HALF_HEIGHT])
    half_width = np.float64(record[HALF_WIDTH])
    across, along = np.float64(record[ACROSS]), np.float64(record[ALONG])
    shear = np.float64(record[SHEAR])
    y_low, y_high = max(y_low, -half_height), min(y_high, half_height)
    reach = along * half_height * half_height
    # the row offset of the rightmost point; the leftmost lies opposite
    tip = -shear * half_height * half_height / half_width
    y = min(max(tip, y_low), y_high)
    right = -shear * y + math.sqrt(max(reach - along * y * y, 0.0) / across)
    y = min(max(-tip, y_low), y_high)
    left = -shear * y - math.sqrt(max(reach - along * y * y, 0.0) / across)
    return left, right


@numba.njit(**EXACT)
def _centre_of(record: np.ndarray) -> tuple[float, float]:
    x = np.float64(record[MEAN_X]) + record[MEAN_X_FRACTION]
    return x, np.float64(record[MEAN_Y]) + record[MEAN_Y_FRACTION]


@numba.njit(**EXACT)
def _tile_box(record: np.ndarray, columns: int, rows: int) -> tuple[int, int, int, int]:
    """Tile columns and rows (first, end, first, end) that a Gaussian's bounding box covers."""
    x, y = _centre_of(record)
    first_column, end_column = _tile_span(x - record[HALF_WIDTH], x + record[HALF_WIDTH], columns)
    first_row, end_row = _tile_span(y - record[HALF_HEIGHT], y + record[HALF_HEIGHT], rows)
    return first_column, end_column, first_row, end_row


@numba.njit(**EXACT)
def _tile_columns(
    record: np.ndarray, row: int, columns: int, box: tuple[int, int, int, int]
) -> tuple[int, int]:
    """First and one past the last tile column a Gaussian reaches in a tile row."""
    if box[1] - box[0] <= 1 or box[3] - box[2] <= 1:
        return box[0], box[1]  # the box is as tight as the ellipse
    x, y = _centre_of(record)
    top = row * TILE_PX + 0.5 - y
    left, right = _reach_across(record, top, top + TILE_PX - 1.0)
    return _tile_span(x + left, x + right, columns)


@numba.njit(**EXACT)
def _count_run(
    records: np.ndarray,
    order: np.ndarray,
    span: tuple[int, int],
    grid: tuple[int, int],
    entry_count: np.ndarray,
    tile_count: np.ndarray,
) -> None:
    columns, rows = grid
    for place in range(span[0], span[1]):
        record = records[order[place]]
        box = _tile_box(record, columns, rows)
        total = 0
        for row in range(box[2], box[3]):
            first_column, end_column = _tile_columns(record, row, columns, box)
            for column in range(first_column, end_column):
                tile_count[row * columns + column] += 1
            total += max(end_column - first_column, 0)
        entry_count[place] = total


@numba.njit(**EXACT)
def _list_run(
    records: np.ndarray, lists: TileLists, span: tuple[int, int], cursor: np.ndarray
) -> None:
    for place in range(span[0], span[1]):
        index = lists.order[place]
        record = records[index]
        position = lists.entry_first[place]
        box = _tile_box(record, lists.columns, lists.rows)
        for row in range(box[2], box[3]):
            first_column, end_column = _tile_columns(record, row, lists.columns, box)
            for column in range(first_column, end_column):
                tile = row * lists.columns + column
                entry = cursor[tile]
                cursor[tile] += 1
                lists.gaussian[entry] = index
                lists.entry[position] = entry
                position += 1


@numba.njit(**EXACT)
def _starts(tile_count: np.ndarray, entry_count: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Turn counts into first places; `tile_count` becomes each run's first entry in each tile."""
    runs, tiles = tile_count.shape
    tile_first = np.empty(tiles + 1, np.int64)
    total = 0
    for tile in range(tiles):
        tile_first[tile] = total
        for run in range(runs):
            count = tile_count[run, tile]
            tile_count[run, tile] = total
            total += count
    tile_first[tiles] = total
    entry_first = np.empty(len(entry_count) + 1, np.int64)
    total = 0
    for place in range(len(entry_count)):
        entry_first[place] = total
        total += entry_count[place]
    entry_first[len(entry_count)] = total
    return tile_first, entry_first


@compiled_entry
def list_tiles(records: np.ndarray, width: int, height: int) -> TileLists:
    """The tile lists of projected Gaussians; the same for any number of threads."""
    columns, rows = (width + TILE_PX - 1) // TILE_PX, (height + TILE_PX - 1) // TILE_PX
    order = depth_order(records)
    count = len(order)
    entry_count = np.empty(count, np.int64)
    tile_count = np.zeros((RUNS, columns * rows), np.int64)
    jump = jump_of(RUNS)
    for place in numba.prange(RUNS):
        run = place * jump % RUNS
        span = (run * count // RUNS, (run + 1) * count // RUNS)
        _count_run(records, order, span, (columns, rows), entry_count, tile_count[run])
    tile_first, entry_first = _starts(tile_count, entry_count)
    gaussian = np.empty(tile_first[-1], np.int32)
    entry = np.empty(tile_first[-1], np.int32)
    lists = TileLists(columns, rows, tile_first, gaussian, order, entry_first, entry)
    for place in numba.prange(RUNS):
        run = place * jump % RUNS
        span = (run * count // RUNS, (run + 1) * count // RUNS)
        _list_run(records, lists, span, tile_count[run])
    return lists
