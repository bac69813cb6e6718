"""List, for every screen tile, the visible Gaussians that reach it, nearest first.

A Gaussian is listed in a tile only if its ellipse alpha >= 1/255 crosses the tile's pixel centres
row band by row band ("AccuTile" of Hanson et al. 2025, "Speedy-Splat"), and with the rows that the
ellipse reaches inside the tile's columns. Entries are dealt to their tiles in the order of the
Gaussians, which goes through memory in streams, and then sorted by depth tile by tile: the entries
of a tile fit in the cache, and tiles do not wait for each other. Compiled code.
"""

from typing import NamedTuple

import numba
import numpy as np

from lidarpainter_models.kernels.gaussian_raster.blending_limits import TILE_PX
from lidarpainter_models.kernels.gaussian_raster.compilation import EXACT, compiled_entry, jump_of
from lidarpainter_models.kernels.gaussian_raster.projection import CHUNKS, DEPTH, IS_VISIBLE
from lidarpainter_models.kernels.gaussian_raster.screen_ellipses import (
    ellipse_of,
    rows_in_tile,
    tile_box,
    tile_columns,
)

REACHES = TILE_PX * TILE_PX
"""A tile and the reach inside it are found as one number, tile times this plus reach."""
FEW_ENTRIES = 32
"""Up to this many entries insertion is faster than counting digits."""


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


class _DealtEntries(NamedTuple):
    """The entries of every tile in the order of the Gaussians, as pairs of 32 bit numbers."""

    key: np.ndarray
    """(entries): depth, and in the low half the place among the tile's entries."""
    owner: np.ndarray
    """(entries): the Gaussian, and in the low half where its entry stands in `TileLists.entry`."""


@numba.njit(**EXACT)
def _pair(high: int, low: int) -> np.uint64:
    return np.uint64(high) << np.uint64(32) | np.uint64(low)


@numba.njit(**EXACT)
def _high(pair: np.uint64) -> np.int64:
    return np.int64(pair >> np.uint64(32))


@numba.njit(**EXACT)
def _low(pair: np.uint64) -> np.int64:
    return np.int64(pair & np.uint64(0xFFFFFFFF))


@numba.njit(**EXACT)
def _count_boxes(
    records: np.ndarray, first: int, end: int, grid: tuple[int, int], own: np.ndarray
) -> None:
    """Tiles that each Gaussian's bounding box touches."""
    for index in range(first, end):
        own[index, 1] = 0
        if records[index, IS_VISIBLE] > 0.0:
            box = tile_box(records[index], grid[0], grid[1])
            own[index, 1] = max(box[1] - box[0], 0) * max(box[3] - box[2], 0)


@numba.njit(**EXACT)
def _find_run(
    records: np.ndarray,
    run: tuple[int, int],
    grid: tuple[int, int],
    own: np.ndarray,
    found: np.ndarray,
    tile_count: np.ndarray,
) -> None:
    """Write the tiles of each Gaussian and its reach in them where its entries will stand."""
    for index in range(run[0], run[1]):
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
                        tile = row * grid[0] + column
                        tile_count[tile] += 1
                        found[position] = tile * REACHES + first_row * TILE_PX + end_row - 1
                        position += 1
            own[index, 1] = position


@numba.njit(**EXACT)
def _deal_run(
    depth_bits: np.ndarray,
    run: tuple[int, int],
    lists: TileLists,
    cursor: np.ndarray,
    dealt: _DealtEntries,
) -> None:
    """Put the entries of each Gaussian behind those that its tiles already have."""
    for index in range(run[0], run[1]):
        for position in range(lists.own[index, 0], lists.own[index, 1]):
            tile = lists.entry[position] // REACHES
            entry = cursor[tile]
            cursor[tile] += 1
            # positive floats sort as their bit patterns do
            dealt.key[entry] = _pair(depth_bits[index], entry - lists.tile_first[tile])
            dealt.owner[entry] = _pair(index, position)


@numba.njit(**EXACT)
def _sort_few(keys: np.ndarray) -> None:
    """Sort in place by insertion."""
    for place in range(1, len(keys)):
        key = keys[place]
        target = place
        while target > 0 and keys[target - 1] > key:
            keys[target] = keys[target - 1]
            target -= 1
        keys[target] = key


@numba.njit(**EXACT)
def _sorted_by_depth(keys: np.ndarray) -> np.ndarray:
    """Keys by their high half, equal ones as they stood; byte by byte, the lowest first."""
    starts = np.zeros((4, 256), np.int32)
    for key in keys:
        for digit in range(4):
            starts[digit, (key >> np.uint64(32 + 8 * digit)) & np.uint64(255)] += 1
    other = np.empty_like(keys)
    for digit in range(4):
        shift = np.uint64(32 + 8 * digit)
        start = starts[digit]
        if start[(keys[0] >> shift) & np.uint64(255)] == len(keys):
            continue
        total = 0
        for value in range(256):
            count = start[value]
            start[value] = total
            total += count
        for key in keys:
            value = (key >> shift) & np.uint64(255)
            other[start[value]] = key
            start[value] += 1
        keys, other = other, keys
    return keys


@numba.njit(**EXACT)
def _list_tile(lists: TileLists, tile: int, dealt: _DealtEntries) -> None:
    """Sort the entries of a tile and note for each Gaussian where its entry went."""
    first, end = lists.tile_first[tile], lists.tile_first[tile + 1]
    keys = dealt.key[first:end]
    if end - first <= FEW_ENTRIES:
        _sort_few(keys)
    else:
        keys = _sorted_by_depth(keys)
    for rank in range(end - first):
        owner = dealt.owner[first + _low(keys[rank])]
        position = _low(owner)
        lists.gaussian[first + rank] = _high(owner)
        lists.reach[first + rank] = lists.entry[position] % REACHES
        lists.entry[position] = first + rank


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
    count, tiles, grid = len(records), columns * rows, (columns, rows)
    own = np.empty((count, 2), np.int32)
    jump = jump_of(CHUNKS)
    for place in numba.prange(CHUNKS):
        run = place * jump % CHUNKS
        _count_boxes(records, run * count // CHUNKS, (run + 1) * count // CHUNKS, grid, own)
    found = np.empty(_entry_starts(own), np.int32)
    tile_count = np.zeros((CHUNKS, tiles), np.int32)
    for place in numba.prange(CHUNKS):
        run = place * jump % CHUNKS
        span = (run * count // CHUNKS, (run + 1) * count // CHUNKS)
        _find_run(records, span, grid, own, found, tile_count[run])
    tile_first = _tile_starts(tile_count)
    entries = tile_first[-1]
    gaussian, reach = np.empty(entries, np.int32), np.empty(entries, np.uint8)
    lists = TileLists(columns, rows, tile_first, gaussian, reach, own, found)
    dealt = _DealtEntries(np.empty(entries, np.uint64), np.empty(entries, np.uint64))
    depth_bits = records.view(np.uint32)[:, DEPTH]
    for place in numba.prange(CHUNKS):
        run = place * jump % CHUNKS
        span = (run * count // CHUNKS, (run + 1) * count // CHUNKS)
        _deal_run(depth_bits, span, lists, tile_count[run], dealt)
    jump = jump_of(tiles)
    for place in numba.prange(tiles):
        _list_tile(lists, place * jump % tiles, dealt)
    return lists
