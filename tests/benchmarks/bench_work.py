"""Operations and bytes that the kernels cannot do without, counted from their inputs."""

import math
from dataclasses import dataclass

import numba
import numpy as np

from lidarpainter_models.kernels.gaussian_raster.binning import end_row_of, first_row_of
from lidarpainter_models.kernels.gaussian_raster.blending import BATCH, CUT, STOP, TOP, local_centre
from lidarpainter_models.kernels.gaussian_raster.blending_limits import TILE_PX
from lidarpainter_models.kernels.gaussian_raster.projection import (
    ACROSS,
    ALONG,
    LOG_OPACITY,
    RECORD_FLOATS,
    SHEAR,
)

# Additions and multiplications of a pixel lane; comparisons, selections and what a row shares are
# not counted, a division is one.
LANE_EXPONENT = 4  # u; across u u from the row's exponent
LANE_EXPONENTIAL = 14  # scaling, degree 5, three squarings
LANE_LIGHT = 2  # weight, light left
LANE_COLOURS = 8  # red, green, blue, depth
FORWARD_LANE_FLOP = LANE_EXPONENT + LANE_EXPONENTIAL + LANE_LIGHT + LANE_COLOURS
LANE_VALUE = 7 + 2  # gradient dotted with colours; what lies behind
LANE_SLOPE = 5  # of the logarithm of alpha
LANE_SUMS = 13 + 8 + 5  # moments of the slope; colours and depth; absolute screen gradient
BACKWARD_LANE_FLOP = (
    LANE_EXPONENT + LANE_EXPONENTIAL + LANE_LIGHT + LANE_VALUE + LANE_SLOPE + LANE_SUMS
)

GAUSSIAN_FLOATS = 3 + 4 + 3 + 1 + 48 + 1 + 2  # as `Gaussians` lists them, degree 3, no features
IMAGE_FLOATS = 3 + 1 + 1 + 1
SUM_FLOATS = 12
ENTRY_BYTES = 4 + 1 + 4
SSIM_FLOP_PER_VALUE = 7 * 2 * 16 + 60  # seven blurs in two directions; the map and its slopes
SSIM_BYTES_PER_VALUE = 4 * 3 + 2 * 4 * 7  # images and gradient; row blurs written and read
ADAM_FLOP, ADAM_BYTES = 14, 4 * 7  # per number: read four, write three


@dataclass(frozen=True)
class Lanes:
    """Pixel lanes that drawing an image evaluates, and how many of them blend something."""

    evaluated: int
    blended: int


def count_lanes(records, lists, height, width):
    """Walk the tile lists as the kernels do, early stop included."""
    return Lanes(*(int(number) for number in _count_lanes(records, lists, height, width)))


@numba.njit(error_model="numpy")
def _count_lanes(records, lists, height, width):
    evaluated, blended = 0, 0
    for tile in range(lists.columns * lists.rows):
        left, top = tile % lists.columns * TILE_PX, tile // lists.columns * TILE_PX
        light = np.zeros((TILE_PX, TILE_PX), np.float32)
        light[: min(TILE_PX, height - top), : min(TILE_PX, width - left)] = 1.0
        first = lists.tile_first[tile]
        for entry in range(first, lists.tile_first[tile + 1]):
            if (entry - first) % BATCH == 0 and light.max() <= 0.0:
                break
            rows = first_row_of(lists.reach[entry]), end_row_of(lists.reach[entry])
            evaluated += (rows[1] - rows[0]) * TILE_PX
            blended += _blended(records[lists.gaussian[entry]], left, top, rows, light)
    return evaluated, blended


@numba.njit(error_model="numpy")
def _blended(record, left, top, rows, light):
    x, y = local_centre(record, left, top)
    count = 0
    for row in range(rows[0], rows[1]):
        for column in range(TILE_PX):
            dy = row + 0.5 - y
            u = column + 0.5 - x + record[SHEAR] * dy
            exponent = record[LOG_OPACITY] - record[ALONG] * dy * dy - record[ACROSS] * u * u
            alpha = math.exp(exponent)
            if alpha >= CUT and light[row, column] > 0.0:
                remaining = light[row, column] * (1.0 - (alpha if alpha < TOP else TOP))
                count += remaining >= STOP
                light[row, column] = remaining if remaining >= STOP else 0.0
    return count


def raster_bytes(count, visible, entries, pixels):
    """Bytes that each stage of the rasteriser has to move, by its name."""
    record = 4 * RECORD_FLOATS
    return {
        "project": count * (4 * GAUSSIAN_FLOATS + record),
        "list_tiles": visible * record + 2 * entries * ENTRY_BYTES,
        "blend": entries * (record + ENTRY_BYTES) + 4 * pixels * IMAGE_FLOATS,
        "blend_gradients": entries * (record + ENTRY_BYTES + 4 * SUM_FLOATS)
        + 8 * pixels * IMAGE_FLOATS,
        "unproject": count * 8 * GAUSSIAN_FLOATS + entries * (4 * SUM_FLOATS + ENTRY_BYTES),
    }
