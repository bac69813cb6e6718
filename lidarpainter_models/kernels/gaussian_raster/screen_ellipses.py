"""Which tiles, and which rows inside them, the ellipse alpha >= 1/255 of a Gaussian reaches.

Pixels count by their centres. The ellipse is across (dx + shear dy)^2 + along dy^2 <= R about the
Gaussian's centre (`projection`); seen by columns it is steep (dy + lean dx)^2 + flat dx^2 <= R.
Compiled code, float64.
"""

import math
from typing import NamedTuple

import numba
import numpy as np

from lidarpainter_models.kernels.gaussian_raster.blending_limits import TILE_PX
from lidarpainter_models.kernels.gaussian_raster.compilation import EXACT
from lidarpainter_models.kernels.gaussian_raster.projection import (
    ACROSS,
    ALONG,
    HALF_HEIGHT,
    HALF_WIDTH,
    MEAN_X,
    MEAN_X_FRACTION,
    MEAN_Y,
    MEAN_Y_FRACTION,
    SHEAR,
)

ROUNDING_PX = 1e-3
"""Slack of the tests; what it lets in too much fails the exact test of the pixel."""


class Ellipse(NamedTuple):
    """Centre and half size in pixels, and its edge by rows and by columns.

    At a row offset dy it spans -slope dy +- sqrt(square + bend dy^2); the end farthest right lies
    at the row offset `tip`. By columns likewise.
    """

    x: float
    y: float
    half_width: float
    half_height: float
    row_slope: float
    row_square: float
    row_bend: float
    row_tip: float
    column_slope: float
    column_square: float
    column_bend: float
    column_tip: float


@numba.njit(**EXACT)
def ellipse_of(record: np.ndarray) -> Ellipse:
    """The ellipse of a screen record."""
    x = np.float64(record[MEAN_X]) + record[MEAN_X_FRACTION]
    y = np.float64(record[MEAN_Y]) + record[MEAN_Y_FRACTION]
    half_width = np.float64(record[HALF_WIDTH])
    half_height = np.float64(record[HALF_HEIGHT])
    across, along = np.float64(record[ACROSS]), np.float64(record[ALONG])
    shear = np.float64(record[SHEAR])
    limit = along * half_height * half_height
    by_across = 1.0 / across
    flat = limit / (half_width * half_width)
    by_steep = 1.0 / (across * shear * shear + along)
    return Ellipse(
        x,
        y,
        half_width,
        half_height,
        shear,
        limit * by_across,
        -along * by_across,
        -shear * half_height * half_height / half_width,
        across * shear * by_steep,
        limit * by_steep,
        -flat * by_steep,
        -shear * half_height,
    )


@numba.njit(**EXACT)
def _edges(
    slope: float, square: float, bend: float, tip: float, low: float, high: float
) -> tuple[float, float]:
    """Least and greatest of -slope t -+ sqrt(square + bend t^2) between two offsets t."""
    t = min(max(tip, low), high)
    greatest = -slope * t + math.sqrt(max(square + bend * t * t, 0.0))
    t = min(max(-tip, low), high)
    return -slope * t - math.sqrt(max(square + bend * t * t, 0.0)), greatest


@numba.njit(**EXACT)
def _tile_span(low_px: float, high_px: float, tiles: int) -> tuple[int, int]:
    """First and one past the last tile whose pixel centres lie between two positions."""
    first = math.ceil(max(low_px - ROUNDING_PX, 0.0) - 0.5)
    last = math.floor(min(high_px + ROUNDING_PX, tiles * TILE_PX + 0.0) - 0.5)
    return int(first) // TILE_PX, min(int(last) // TILE_PX + 1, tiles)


@numba.njit(**EXACT)
def tile_box(record: np.ndarray, columns: int, rows: int) -> tuple[int, int, int, int]:
    """Tile columns and rows (first, end, first, end) that a Gaussian's bounding box covers."""
    x = np.float64(record[MEAN_X]) + record[MEAN_X_FRACTION]
    y = np.float64(record[MEAN_Y]) + record[MEAN_Y_FRACTION]
    first_column, end_column = _tile_span(x - record[HALF_WIDTH], x + record[HALF_WIDTH], columns)
    first_row, end_row = _tile_span(y - record[HALF_HEIGHT], y + record[HALF_HEIGHT], rows)
    return first_column, end_column, first_row, end_row


@numba.njit(**EXACT)
def tile_columns(
    ellipse: Ellipse, row: int, columns: int, box: tuple[int, int, int, int]
) -> tuple[int, int]:
    """First and one past the last tile column a Gaussian reaches in a tile row."""
    if box[1] - box[0] <= 1 or box[3] - box[2] <= 1:
        return box[0], box[1]  # the box is as tight as the ellipse
    low = max(row * TILE_PX + 0.5 - ellipse.y, -ellipse.half_height)
    high = min((row + 1) * TILE_PX - 0.5 - ellipse.y, ellipse.half_height)
    left, right = _edges(
        ellipse.row_slope, ellipse.row_square, ellipse.row_bend, ellipse.row_tip, low, high
    )
    return _tile_span(ellipse.x + left, ellipse.x + right, columns)


@numba.njit(**EXACT)
def rows_in_tile(
    ellipse: Ellipse, row: int, column: int, box: tuple[int, int, int, int]
) -> tuple[int, int]:
    """First and one past the last pixel row of a tile that a Gaussian reaches in its columns."""
    top, bottom = -ellipse.half_height, ellipse.half_height
    if box[1] - box[0] > 1:
        low = max(column * TILE_PX + 0.5 - ellipse.x, -ellipse.half_width)
        high = min((column + 1) * TILE_PX - 0.5 - ellipse.x, ellipse.half_width)
        top, bottom = _edges(
            ellipse.column_slope,
            ellipse.column_square,
            ellipse.column_bend,
            ellipse.column_tip,
            low,
            high,
        )
    centre = ellipse.y - row * TILE_PX
    first = math.ceil(max(centre + top - ROUNDING_PX, 0.0) - 0.5)
    last = math.floor(min(centre + bottom + ROUNDING_PX, TILE_PX + 0.0) - 0.5)
    return int(first), int(last) + 1
