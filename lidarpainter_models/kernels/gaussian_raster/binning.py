"""Sort visible Gaussians by depth and list, for every screen tile, those that reach it.

A Gaussian is listed in a tile only if its ellipse alpha >= 1/255 crosses the tile's pixel centres
row band by row band ("AccuTile" of Hanson et al. 2025, "Speedy-Splat"), and with the rows that the
ellipse reaches inside the tile's columns. The lists are filled in depth order by counting, so they
need no sort of their own. Compiled code.
"""

from typing import NamedTuple

import numba
import numpy as np

from lidarpainter_models.kernels.gaussian_raster.blending_limits import TILE_PX
from lidarpainter_models.kernels.gaussian_raster.compilation import EXACT, compiled_entry
from lidarpainter_models.kernels.gaussian_raster.projection import CHUNKS, DEPTH, IS_VISIBLE
from lidarpainter_models.kernels.gaussian_raster.screen_ellipses import (
    ellipse_of,
    rows_in_tile,
    tile_box,
    tile_columns,
)
from lidarpainter_models.kernels.gaussian_raster.work_sharing import jump_of

RUNS = 16
"""The depth order is cut into this many runs that are listed independently of each other."""
RADIX_BITS = 11
REACHES = TILE_PX * TILE_PX
"""A tile and the reach inside it are found as one number, tile times this plus reach."""


class TileLists(NamedTuple):
    """Which Gaussians reach which tile, and where each Gaussian's entries lie."""

    columns: int
    rows: int
    tile_first: np.ndarray
    """(tiles + 1): entries of tile t are `tile_first[t] : tile_first[t + 1]`, nearest first."""
    gaussian: np.ndarray
    """(entries): index of the Gaussian."""
    reach: np.ndarray
    """(entries): rows of the tile that it reaches, see `first_row_of` and `end_row_of`."""
    own: np.ndarray
    """(gaussians, 2): where a Gaussian's entries begin and end in `entry`."""
    entry: np.ndarray
    """Numbers of the entries, Gaussian by Gaussian with gaps, tiles in reading order."""


@numba.njit(**EXACT)
def first_row_of(reach: int) -> int:
    """First row of a tile in an entry's reach."""
    return reach // TILE_PX


@numba.njit(**EXACT)
def end_row_of(reach: int) -> int:
    """One past the last row of a tile in an entry's reach."""
    return reach % TILE_PX + 1


@numba.njit(**EXACT)
def _count_boxes(
    records: np.ndarray, first: int, end: int, grid: tuple[int, int], own: np.ndarray
) -> int:
    """Tiles that each Gaussian's bounding box touches; returns how many Gaussians are visible."""
    visible = 0
    for index in range(first, end):
        own[index, 1] = 0
        if records[index, IS_VISIBLE] > 0.0:
            box = tile_box(records[index], grid[0], grid[1])
            own[index, 1] = max(box[1] - box[0], 0) * max(box[3] - box[2], 0)
            visible += 1
    return visible


@numba.njit(**EXACT)
def _depth_order(records: np.ndarray, count: int) -> np.ndarray:
    """Indices of the visible Gaussians by depth; equal depths keep the order of their index."""
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
def _find_run(
    records: np.ndarray,
    first: int,
    end: int,
    grid: tuple[int, int],
    own: np.ndarray,
    found: np.ndarray,
) -> None:
    """Write the tiles of each Gaussian and its reach in them where its entries will stand."""
    for index in range(first, end):
        if records[index, IS_VISIBLE] > 0.0:
            record = records[index]
            position = own[index, 0]
            box = tile_box(record, grid[0], grid[1])
            ellipse = ellipse_of(record)
            for row in range(box[2], box[3]):
                columns = tile_columns(ellipse, row, grid[0], box)
                for column in range(columns[0], columns[1]):
                    first_row, end_row = rows_in_tile(ellipse, row, column, box)
                    if first_row < end_row:
                        reach = first_row * TILE_PX + end_row - 1
                        found[position] = (row * grid[0] + column) * REACHES + reach
                        position += 1
            own[index, 1] = position


@numba.njit(**EXACT)
def _count_run(
    order: np.ndarray, own: np.ndarray, found: np.ndarray, tile_count: np.ndarray
) -> None:
    """Count the entries of each tile."""
    for index in order:
        for position in range(own[index, 0], own[index, 1]):
            tile_count[found[position] // REACHES] += 1


@numba.njit(**EXACT)
def _list_run(order: np.ndarray, lists: TileLists, cursor: np.ndarray) -> None:
    """Turn the tiles of each Gaussian into entries of these tiles' lists."""
    for index in order:
        for position in range(lists.own[index, 0], lists.own[index, 1]):
            tile, reach = lists.entry[position] // REACHES, lists.entry[position] % REACHES
            entry = cursor[tile]
            cursor[tile] += 1
            lists.gaussian[entry] = index
            lists.reach[entry] = reach
            lists.entry[position] = entry


@numba.njit(**EXACT)
def _tile_starts(tile_count: np.ndarray) -> np.ndarray:
    """First entry of every tile; `tile_count` becomes each run's first entry in each tile."""
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
    return tile_first


@numba.njit(**EXACT)
def _entry_starts(own: np.ndarray) -> int:
    """Turn the sizes of the boxes into first places; returns the room for all."""
    total = 0
    for index in range(len(own)):
        room = own[index, 1]
        own[index, 0] = own[index, 1] = total
        total += room
    return total


@compiled_entry
def list_tiles(records: np.ndarray, width: int, height: int) -> TileLists:
    """The tile lists of projected Gaussians; the same for any number of threads."""
    columns, rows = (width + TILE_PX - 1) // TILE_PX, (height + TILE_PX - 1) // TILE_PX
    count, grid = len(records), (columns, rows)
    own = np.empty((count, 2), np.int32)
    visible = 0
    jump = jump_of(CHUNKS)
    for place in numba.prange(CHUNKS):
        run = place * jump % CHUNKS
        first, end = run * count // CHUNKS, (run + 1) * count // CHUNKS
        visible += _count_boxes(records, first, end, grid, own)
    found = np.empty(_entry_starts(own), np.int32)
    for place in numba.prange(CHUNKS):
        run = place * jump % CHUNKS
        first, end = run * count // CHUNKS, (run + 1) * count // CHUNKS
        _find_run(records, first, end, grid, own, found)
    order = _depth_order(records, visible)
    tile_count = np.zeros((RUNS, columns * rows), np.int64)
    for run in numba.prange(RUNS):
        part = order[run * visible // RUNS : (run + 1) * visible // RUNS]
        _count_run(part, own, found, tile_count[run])
    tile_first = _tile_starts(tile_count)
    gaussian, reach = np.empty(tile_first[-1], np.int32), np.empty(tile_first[-1], np.uint8)
    lists = TileLists(columns, rows, tile_first, gaussian, reach, own, found)
    for run in numba.prange(RUNS):
        part = order[run * visible // RUNS : (run + 1) * visible // RUNS]
        _list_run(part, lists, tile_count[run])
    return lists
