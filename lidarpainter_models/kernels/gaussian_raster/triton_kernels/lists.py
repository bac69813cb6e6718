"""Which tile each pair of a Gaussian and a tile of its bounding box stands for, and in what order.

Frames and forms are those of the numba `screen_ellipses`: the ellipse where alpha reaches 1/255
spans, in a tile row, the columns between its leftmost and its rightmost point there.
"""

import triton
import triton.language as tl

from lidarpainter_models.kernels.gaussian_raster.triton_kernels import records as screen
from lidarpainter_models.kernels.gaussian_raster.triton_kernels.records import (
    load_place,
    record_of,
    tile_box,
    tile_span,
)


@triton.jit
def _edge(slope, square, bend, tip, low, high):
    """Greatest of -slope t + sqrt(square + bend t^2) between two offsets t."""
    t = tl.minimum(tl.maximum(tip, low), high)
    return -slope * t + tl.sqrt(tl.maximum(square + bend * t * t, 0.0))


@triton.jit
def _tile_columns(record, place, row, mask, columns):
    """First and one past the last tile column that ellipses reach in a tile row."""
    x, y, half_width, half_height = place
    across = tl.load(record + screen.ACROSS, mask=mask, other=1.0).to(tl.float64)
    shear = tl.load(record + screen.SHEAR, mask=mask, other=0.0).to(tl.float64)
    along = tl.load(record + screen.ALONG, mask=mask, other=1.0).to(tl.float64)
    low = tl.maximum(row * screen.TILE_PX + 0.5 - y, -half_height)
    high = tl.minimum((row + 1) * screen.TILE_PX - 0.5 - y, half_height)
    square, bend = along * half_height * half_height / across, -along / across
    tip = -shear * half_height * half_height / tl.maximum(half_width, 1e-12)
    right = _edge(shear, square, bend, tip, low, high)
    left = -_edge(shear, square, bend, tip, -high, -low)  # the ellipse is the same turned round
    return tile_span(x + left, x + right, columns)


@triton.jit(do_not_specialize=["pairs", "columns", "rows"])
def write_keys(records, owner, first_pair, keys, pairs, columns, rows, BLOCK: tl.constexpr):
    """Write what sorts pairs by tile and then by depth; those that miss their tile come last.

    A Gaussian's pairs lie side by side from `first_pair` on; `columns` and `rows` are of tiles.
    """
    pair = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    exists = pair < pairs
    gaussian = tl.load(owner + pair, mask=exists, other=0)
    rank = (pair - tl.load(first_pair + gaussian, mask=exists, other=0)).to(tl.int32)
    record = record_of(records, gaussian)
    place = load_place(record, exists)
    first_column, end_column, first_row, end_row = tile_box(place, columns, rows)
    width = tl.maximum(end_column - first_column, 1)
    row, column = first_row + rank // width, first_column + rank % width
    first_reached, end_reached = _tile_columns(record, place, row, exists, columns)
    # a box of one row or one column is as tight as the ellipse
    is_tight = (width == 1) | (end_row - first_row == 1)
    reaches = is_tight | ((first_reached <= column) & (column < end_reached))
    tile = tl.where(reaches, row * columns + column, rows * columns)
    depth = tl.load(record + screen.DEPTH, mask=exists, other=0.0)
    # positive floats sort as their bit patterns do
    key = (tile.to(tl.int64) << 32) | depth.to(tl.int32, bitcast=True).to(tl.int64)
    tl.store(keys + pair, key, mask=exists)
