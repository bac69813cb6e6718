"""Blend the Gaussians of each screen tile front to back: compiled code, float32 lanes.

A tile's pixels lie in one flat work array, quantity after quantity, row after row; a row of sixteen
is one value (`lanes`). What a row shares is computed once for it.
"""

from typing import NamedTuple

import numba
import numpy as np

from lidarpainter_models.kernels.gaussian_raster.binning import TileLists, end_row_of, first_row_of
from lidarpainter_models.kernels.gaussian_raster.blending_limits import (
    ALPHA_CUT,
    MAX_ALPHA,
    MIN_TRANSMITTANCE,
    TILE_PX,
)
from lidarpainter_models.kernels.gaussian_raster.compilation import EXACT, compiled_entry, jump_of
from lidarpainter_models.kernels.gaussian_raster.lane_types import (
    choose,
    largest,
    load,
    magnitude,
    smallest,
    store,
)
from lidarpainter_models.kernels.gaussian_raster.lanes import (
    lane_array,
    lane_centres,
    lane_exp,
    prefetch,
    spread,
    store_triples,
    widest,
)
from lidarpainter_models.kernels.gaussian_raster.projection import (
    ACROSS,
    ALONG,
    BLUE,
    DEPTH,
    GREEN,
    LOG_OPACITY,
    MEAN_X,
    MEAN_X_FRACTION,
    MEAN_Y,
    MEAN_Y_FRACTION,
    RECORD_FLOATS,
    RED,
    SHEAR,
)

PIXELS = TILE_PX * TILE_PX
BATCH = 16
"""Gaussians whose records are fetched together, while those before are blended; before each batch
the tile is left if it has stopped."""

# Where each quantity of a tile begins in its work array.
LIGHT, LANE_RED, LANE_GREEN, LANE_BLUE, LANE_DEPTH, WEIGHT = (k * PIXELS for k in range(6))
FEATURES = 6 * PIXELS

CUT = np.float32(ALPHA_CUT)
TOP = np.float32(MAX_ALPHA)
STOP = np.float32(MIN_TRANSMITTANCE)
HALF = np.float32(0.5)
ZERO = np.float32(0.0)
ONE = np.float32(1.0)
FAR = np.float32(-5.7)
"""Exponents are held above this, where `lane_exp` is accurate and alpha is under the cut."""


class Images(NamedTuple):
    """Blended sums per pixel, float32 (height, width[, channels])."""

    rgb: np.ndarray
    depth: np.ndarray
    alpha: np.ndarray
    features: np.ndarray
    light: np.ndarray
    """What passes all Gaussians; 1 - alpha, with all its digits."""


@numba.njit(**EXACT)
def flat_images(images: Images) -> Images:
    """The same images, one number after the other."""
    return Images(
        images.rgb.reshape(-1),
        images.depth.reshape(-1),
        images.alpha.reshape(-1),
        images.features.reshape(-1),
        images.light.reshape(-1),
    )


@numba.njit(**EXACT)
def local_centre(record: np.ndarray, tile_x: int, tile_y: int) -> tuple[float, float]:
    """Centre of a Gaussian from the corner of a tile, pixels; exact to float32."""
    return (
        (record[MEAN_X] - np.float32(tile_x)) + record[MEAN_X_FRACTION],
        (record[MEAN_Y] - np.float32(tile_y)) + record[MEAN_Y_FRACTION],
    )


@numba.njit(**EXACT)
def fetch_records(
    records: np.ndarray, gaussian: np.ndarray, first: int, end: int, batch: np.ndarray
) -> int:
    """Copy a batch of records from an entry on side by side, and ask for the next one.

    Returns one past the last entry of the batch.
    """
    flat = records.reshape(-1)
    last = min(first + BATCH, end)
    for entry in range(first, last):
        source = np.int64(gaussian[entry]) * RECORD_FLOATS
        store(batch, (entry - first) * RECORD_FLOATS, load(flat, source))
    for entry in range(last, min(last + BATCH, end)):
        prefetch(flat, np.int64(gaussian[entry]) * RECORD_FLOATS)
    return last


@numba.njit(**EXACT)
def has_light(lanes: np.ndarray) -> bool:
    """Whether any pixel of a tile still takes Gaussians."""
    brightest = load(lanes, LIGHT)
    for row in range(1, TILE_PX):
        brightest = largest(brightest, load(lanes, LIGHT + row * TILE_PX))
    return widest(brightest) > ZERO


@numba.njit(**EXACT)
def _blend(
    lanes: np.ndarray,
    first_row: int,
    end_row: int,
    centre: tuple[float, float],
    record: np.ndarray,
    keeps_weight: bool,
) -> None:
    """Blend one Gaussian into rows of a tile. A stopped pixel has its light negated."""
    shear, along, log_opacity = record[SHEAR], record[ALONG], record[LOG_OPACITY]
    across = spread(record[ACROSS])
    red, green, blue = spread(record[RED]), spread(record[GREEN]), spread(record[BLUE])
    depth = spread(record[DEPTH])
    offset = lane_centres() - centre[0]
    for row in range(first_row, end_row):
        pixel = row * TILE_PX
        dy = np.float32(row) + HALF - centre[1]
        u = offset + shear * dy
        exponent = log_opacity - along * dy * dy - across * u * u
        alpha = lane_exp(largest(exponent, FAR))
        alpha = choose(alpha >= CUT, smallest(alpha, TOP), ZERO)
        light = load(lanes, LIGHT + pixel)
        weight = light * alpha
        left = light - weight
        goes_on = left >= STOP
        weight = choose(goes_on, weight, ZERO)
        store(lanes, LIGHT + pixel, choose(goes_on, left, ZERO - magnitude(light)))
        store(lanes, LANE_RED + pixel, load(lanes, LANE_RED + pixel) + weight * red)
        store(lanes, LANE_GREEN + pixel, load(lanes, LANE_GREEN + pixel) + weight * green)
        store(lanes, LANE_BLUE + pixel, load(lanes, LANE_BLUE + pixel) + weight * blue)
        store(lanes, LANE_DEPTH + pixel, load(lanes, LANE_DEPTH + pixel) + weight * depth)
        if keeps_weight:
            store(lanes, WEIGHT + pixel, weight)


@numba.njit(**EXACT)
def _blend_features(lanes: np.ndarray, first_row: int, end_row: int, features: np.ndarray) -> None:
    for channel in range(len(features)):
        value = spread(features[channel])
        start = FEATURES + channel * PIXELS
        for pixel in range(first_row * TILE_PX, end_row * TILE_PX, TILE_PX):
            blended = load(lanes, start + pixel) + load(lanes, WEIGHT + pixel) * value
            store(lanes, start + pixel, blended)


@numba.njit(**EXACT)
def _blend_tile(
    records: np.ndarray,
    features: np.ndarray,
    lists: TileLists,
    tile: int,
    corner: tuple[int, int],
    lanes: np.ndarray,
) -> None:
    batch = lane_array(BATCH * RECORD_FLOATS)
    has_features = features.shape[1] > 0
    end = lists.tile_first[tile + 1]
    for first in range(lists.tile_first[tile], end, BATCH):
        if not has_light(lanes):
            break
        last = fetch_records(records, lists.gaussian, first, end, batch)
        for entry in range(first, last):
            place = (entry - first) * RECORD_FLOATS
            record = batch[place : place + RECORD_FLOATS]
            first_row, end_row = first_row_of(lists.reach[entry]), end_row_of(lists.reach[entry])
            centre = local_centre(record, corner[0], corner[1])
            _blend(lanes, first_row, end_row, centre, record, has_features)
            if has_features:
                _blend_features(lanes, first_row, end_row, features[lists.gaussian[entry]])


@numba.njit(**EXACT)
def _store_row(lanes: np.ndarray, row: int, place: int, flat: Images) -> None:
    """Write a whole tile row to pixels from a place on."""
    pixel = row * TILE_PX
    left = magnitude(load(lanes, LIGHT + pixel))
    store(flat.light, place, left)
    store(flat.alpha, place, ONE - left)
    store(flat.depth, place, load(lanes, LANE_DEPTH + pixel))
    red, green = load(lanes, LANE_RED + pixel), load(lanes, LANE_GREEN + pixel)
    store_triples(flat.rgb, 3 * place, red, green, load(lanes, LANE_BLUE + pixel))


@numba.njit(**EXACT)
def _store_tile(lanes: np.ndarray, corner: tuple[int, int], images: Images) -> None:
    height, width, channels = images.features.shape
    flat = flat_images(images)
    columns = min(TILE_PX, width - corner[0])
    for row in range(min(TILE_PX, height - corner[1])):
        place = (corner[1] + row) * width + corner[0]
        if columns == TILE_PX:
            _store_row(lanes, row, place, flat)
        else:
            _store_part_of_row(lanes, row, place, columns, flat)
        features = images.features[corner[1] + row]
        for channel in range(channels):
            start = FEATURES + channel * PIXELS + row * TILE_PX
            for column in range(columns):
                features[corner[0] + column, channel] = lanes[start + column]


@numba.njit(**EXACT)
def _store_part_of_row(lanes: np.ndarray, row: int, place: int, columns: int, flat: Images) -> None:
    """Write the first pixels of a tile row that the image's edge cuts."""
    for column in range(columns):
        pixel = row * TILE_PX + column
        left = abs(lanes[LIGHT + pixel])
        flat.light[place + column] = left
        flat.alpha[place + column] = ONE - left
        flat.depth[place + column] = lanes[LANE_DEPTH + pixel]
        for channel in range(3):
            flat.rgb[3 * (place + column) + channel] = lanes[LANE_RED + channel * PIXELS + pixel]


@numba.njit(**EXACT)
def _draw_tile(
    records: np.ndarray, features: np.ndarray, lists: TileLists, tile: int, images: Images
) -> None:
    corner = (tile % lists.columns * TILE_PX, tile // lists.columns * TILE_PX)
    height, width = images.depth.shape
    lanes = lane_array(FEATURES + features.shape[1] * PIXELS)
    lanes[:] = ZERO
    columns = min(TILE_PX, width - corner[0])
    for row in range(min(TILE_PX, height - corner[1])):  # pixels beside the image stay dark
        lanes[row * TILE_PX : row * TILE_PX + columns] = ONE
    _blend_tile(records, features, lists, tile, corner, lanes)
    _store_tile(lanes, corner, images)


@compiled_entry
def blend(
    records: np.ndarray, features: np.ndarray, lists: TileLists, width: int, height: int
) -> Images:
    """Draw all tiles."""
    images = Images(
        np.empty((height, width, 3), np.float32),
        np.empty((height, width), np.float32),
        np.empty((height, width), np.float32),
        np.empty((height, width, features.shape[1]), np.float32),
        np.empty((height, width), np.float32),
    )
    tiles = lists.columns * lists.rows
    jump = jump_of(tiles)
    for place in numba.prange(tiles):
        _draw_tile(records, features, lists, place * jump % tiles, images)
    return images
