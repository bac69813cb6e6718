"""Blend the Gaussians of each screen tile front to back: compiled code, float32 lanes.

A tile's pixels lie in one flat work array, quantity after quantity, row after row, so that the
loop over pixels has no branch and no call and becomes vector instructions.
"""

import math
from typing import NamedTuple

import numba
import numpy as np

from lidarpainter_models.kernels.gaussian_raster.binning import TileLists
from lidarpainter_models.kernels.gaussian_raster.blending_limits import (
    ALPHA_CUT,
    MAX_ALPHA,
    MIN_TRANSMITTANCE,
    TILE_PX,
)
from lidarpainter_models.kernels.gaussian_raster.compilation import EXACT, LANE_LOOP, compiled_entry
from lidarpainter_models.kernels.gaussian_raster.lane_exponential import lane_exp
from lidarpainter_models.kernels.gaussian_raster.projection import (
    ACROSS,
    ALONG,
    BLUE,
    DEPTH,
    GREEN,
    HALF_HEIGHT,
    LOG_OPACITY,
    MEAN_X,
    MEAN_X_FRACTION,
    MEAN_Y,
    MEAN_Y_FRACTION,
    RED,
    SHEAR,
)
from lidarpainter_models.kernels.gaussian_raster.work_sharing import jump_of

PIXELS = TILE_PX * TILE_PX
CHECK_EVERY = 16
"""Gaussians between two looks at whether the whole tile has stopped."""

# Where each quantity of a tile begins in its work array; unsigned, because a signed index could
# be negative and its wrap-around keeps loops scalar.
LIGHT, LANE_RED, LANE_GREEN, LANE_BLUE, LANE_DEPTH, WEIGHT, PIXEL_X, PIXEL_Y = (
    np.uint64(k * PIXELS) for k in range(8)
)
LANES = 8 * PIXELS
FEATURES = 8 * PIXELS

CUT = np.float32(ALPHA_CUT)
TOP = np.float32(MAX_ALPHA)
STOP = np.float32(MIN_TRANSMITTANCE)
ZERO = np.float32(0.0)
ONE = np.float32(1.0)
FAR = np.float32(-5.7)
"""Exponents are held above this, where `lane_exp` is accurate and alpha is under the cut."""


class Pictures(NamedTuple):
    """Blended sums per pixel, float32 (height, width[, channels])."""

    rgb: np.ndarray
    depth: np.ndarray
    alpha: np.ndarray
    features: np.ndarray
    light: np.ndarray
    """What passes all Gaussians; 1 - alpha, with all its digits."""


@numba.njit(**EXACT)
def local_centre(record: np.ndarray, tile_x: int, tile_y: int) -> tuple[float, float]:
    """Centre of a Gaussian from the corner of a tile, pixels; exact to float32."""
    return (
        (record[MEAN_X] - np.float32(tile_x)) + record[MEAN_X_FRACTION],
        (record[MEAN_Y] - np.float32(tile_y)) + record[MEAN_Y_FRACTION],
    )


@numba.njit(**EXACT)
def tile_rows_of(y: float, half_height: float) -> tuple[int, int]:
    """First and one past the last row of a tile that a Gaussian can reach."""
    first = math.ceil(max(y - half_height - 0.5, 0.0))
    end = math.floor(min(y + half_height + 0.5, TILE_PX + 0.0))
    return int(min(first, TILE_PX)), int(max(end, 0.0))


@numba.njit(**EXACT)
def place_pixels(lanes: np.ndarray) -> None:
    """Write the pixel centres of a tile, from its corner, into its work array."""
    for row in range(TILE_PX):
        for column in range(TILE_PX):
            pixel = np.uint64(row * TILE_PX + column)
            lanes[PIXEL_X + pixel] = column + 0.5
            lanes[PIXEL_Y + pixel] = row + 0.5


@numba.njit(**EXACT)
def has_light(lanes: np.ndarray) -> bool:
    """Whether any pixel of a tile still takes Gaussians."""
    brightest = lanes[LIGHT]
    for pixel in range(np.uint64(1), np.uint64(PIXELS)):
        brightest = max(brightest, lanes[LIGHT + pixel])
    return brightest > ZERO


@numba.njit(**LANE_LOOP)
def _blend(
    lanes: np.ndarray, first_row: int, end_row: int, x: float, y: float, record: np.ndarray
) -> None:
    """Blend one Gaussian into rows of a tile. A stopped pixel has its light negated."""
    across, shear, along = record[ACROSS], record[SHEAR], record[ALONG]
    log_opacity = record[LOG_OPACITY]
    red, green, blue, depth = record[RED], record[GREEN], record[BLUE], record[DEPTH]
    for pixel in range(np.uint64(first_row * TILE_PX), np.uint64(end_row * TILE_PX)):
        dy = lanes[PIXEL_Y + pixel] - y
        u = lanes[PIXEL_X + pixel] - x + shear * dy
        alpha = lane_exp(max(log_opacity - along * dy * dy - across * u * u, FAR))
        alpha = min(alpha, TOP) if alpha >= CUT else ZERO
        light = lanes[LIGHT + pixel]
        weight = light * alpha
        left = light - weight
        goes_on = left >= STOP
        weight = weight if goes_on else ZERO
        lanes[LIGHT + pixel] = left if goes_on else -abs(light)
        lanes[WEIGHT + pixel] = weight
        lanes[LANE_RED + pixel] += weight * red
        lanes[LANE_GREEN + pixel] += weight * green
        lanes[LANE_BLUE + pixel] += weight * blue
        lanes[LANE_DEPTH + pixel] += weight * depth


@numba.njit(**LANE_LOOP)
def _blend_features(lanes: np.ndarray, first_row: int, end_row: int, features: np.ndarray) -> None:
    for channel in range(len(features)):
        value = features[channel]
        start = np.uint64(FEATURES + channel * PIXELS)
        for pixel in range(np.uint64(first_row * TILE_PX), np.uint64(end_row * TILE_PX)):
            lanes[start + pixel] += lanes[WEIGHT + pixel] * value


@numba.njit(**EXACT)
def _blend_tile(
    records: np.ndarray,
    features: np.ndarray,
    lists: TileLists,
    tile: int,
    tile_x: int,
    tile_y: int,
    lanes: np.ndarray,
) -> None:
    first, end = lists.tile_first[tile], lists.tile_first[tile + 1]
    for entry in range(first, end):
        if (entry - first) % CHECK_EVERY == CHECK_EVERY - 1 and not has_light(lanes):
            break
        index = lists.gaussian[entry]
        record = records[index]
        x, y = local_centre(record, tile_x, tile_y)
        first_row, end_row = tile_rows_of(y, record[HALF_HEIGHT])
        _blend(lanes, first_row, end_row, x, y, record)
        if features.shape[1]:
            _blend_features(lanes, first_row, end_row, features[index])


@numba.njit(**EXACT)
def _light_pixels(lanes: np.ndarray, rows: int, columns: int) -> None:
    """Give every pixel of a tile that lies in the picture its full light; the rest stay dark."""
    for row in range(rows):
        lanes[row * TILE_PX : row * TILE_PX + columns] = ONE


@numba.njit(**EXACT)
def _store_tile(lanes: np.ndarray, tile_x: int, tile_y: int, pictures: Pictures) -> None:
    height, width, channels = pictures.features.shape
    for row in range(min(TILE_PX, height - tile_y)):
        for column in range(min(TILE_PX, width - tile_x)):
            pixel = row * TILE_PX + column
            y, x = tile_y + row, tile_x + column
            light = abs(lanes[pixel])
            pictures.light[y, x] = light
            pictures.alpha[y, x] = ONE - light
            for channel in range(3):
                pictures.rgb[y, x, channel] = lanes[(1 + channel) * PIXELS + pixel]
            pictures.depth[y, x] = lanes[4 * PIXELS + pixel]
            for channel in range(channels):
                pictures.features[y, x, channel] = lanes[FEATURES + channel * PIXELS + pixel]


@numba.njit(**EXACT)
def _draw_tile(
    records: np.ndarray, features: np.ndarray, lists: TileLists, tile: int, pictures: Pictures
) -> None:
    tile_x, tile_y = tile % lists.columns * TILE_PX, tile // lists.columns * TILE_PX
    height, width = pictures.depth.shape
    lanes = np.zeros(LANES + features.shape[1] * PIXELS, np.float32)
    _light_pixels(lanes, min(TILE_PX, height - tile_y), min(TILE_PX, width - tile_x))
    place_pixels(lanes)
    _blend_tile(records, features, lists, tile, tile_x, tile_y, lanes)
    _store_tile(lanes, tile_x, tile_y, pictures)


@compiled_entry
def blend(
    records: np.ndarray, features: np.ndarray, lists: TileLists, width: int, height: int
) -> Pictures:
    """Draw all tiles."""
    pictures = Pictures(
        np.empty((height, width, 3), np.float32),
        np.empty((height, width), np.float32),
        np.empty((height, width), np.float32),
        np.empty((height, width, features.shape[1]), np.float32),
        np.empty((height, width), np.float32),
    )
    tiles = lists.columns * lists.rows
    jump = jump_of(tiles)
    for place in numba.prange(tiles):
        _draw_tile(records, features, lists, place * jump % tiles, pictures)
    return pictures
