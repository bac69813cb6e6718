"""Carry image gradients back to the Gaussians of each tile: compiled code, float32 lanes.

Tiles are walked front to back once more, with the same early stop as when drawing. What lies
behind a Gaussian is the pixel's total minus what was passed so far, one number per pixel: the
blended value dotted with the image's gradient. Every (tile, Gaussian) entry writes its own sums;
`projection_gradients` adds up the entries of each Gaussian in a fixed order, so results do not
depend on the threads.
"""

import numba
import numpy as np

from lidarpainter_models.kernels.gaussian_raster.binning import TileLists, end_row_of, first_row_of
from lidarpainter_models.kernels.gaussian_raster.blending import (
    BATCH,
    CUT,
    FAR,
    HALF,
    LIGHT,
    ONE,
    PIXELS,
    STOP,
    TOP,
    ZERO,
    Images,
    fetch_records,
    flat_images,
    has_light,
    local_centre,
)
from lidarpainter_models.kernels.gaussian_raster.blending_limits import TILE_PX
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
    load_triples,
    prefetch,
    spread,
    store_sums,
)
from lidarpainter_models.kernels.gaussian_raster.projection import (
    ACROSS,
    ALONG,
    BLUE,
    DEPTH,
    GREEN,
    IS_VISIBLE,
    LOG_OPACITY,
    RECORD_FLOATS,
    RED,
    SHEAR,
)

# Sums over pixels of an entry, with g the gradient of the exponent, u and dy the pixel's offset
# in the sheared frame of the footprint (`projection`).
SUM_G, SUM_GU, SUM_GUU, SUM_GY, SUM_GUY, SUM_GYY = 0, 1, 2, 3, 4, 5
SUM_RED, SUM_GREEN, SUM_BLUE, SUM_DEPTH, SUM_ABS_X, SUM_ABS_Y = 6, 7, 8, 9, 10, 11
SUMS = 12

# The work array shares LIGHT with drawing.
GRAD_RED, GRAD_GREEN, GRAD_BLUE, GRAD_DEPTH, BEHIND, WEIGHT, FEATURE_VALUE = (
    k * PIXELS for k in range(1, 8)
)
FEATURES = 8 * PIXELS


@numba.njit(**EXACT)
def _entry_sums(  # noqa: PLR0915 - one loop body; calls would be no clearer
    lanes: np.ndarray,
    rows: tuple[int, int],
    centre: tuple[float, float],
    record: np.ndarray,
    has_features: bool,
    slots: np.ndarray,
    slot: int,
) -> None:
    """Sums of one Gaussian over rows of a tile; moves the pixels' light and rest along."""
    shear, along, log_opacity = record[SHEAR], record[ALONG], record[LOG_OPACITY]
    across, cross = spread(record[ACROSS]), spread(record[ACROSS] * record[SHEAR])
    red, green, blue = spread(record[RED]), spread(record[GREEN]), spread(record[BLUE])
    depth = spread(record[DEPTH])
    offset = lane_centres() - centre[0]
    g0 = gu = guu = gy = guy = gyy = spread(ZERO)
    sum_red = sum_green = sum_blue = sum_depth = abs_x = abs_y = spread(ZERO)
    for row in range(rows[0], rows[1]):
        pixel = row * TILE_PX
        dy = np.float32(row) + HALF - centre[1]
        u = offset + shear * dy
        exponent = log_opacity - along * dy * dy - across * u * u
        raw = lane_exp(largest(exponent, FAR))
        alpha = choose(raw >= CUT, smallest(raw, TOP), ZERO)
        light = load(lanes, LIGHT + pixel)
        weight = light * alpha
        left = light - weight
        goes_on = left >= STOP
        weight = choose(goes_on, weight, ZERO)
        store(lanes, LIGHT + pixel, choose(goes_on, left, ZERO - magnitude(light)))
        grad_red, grad_green = load(lanes, GRAD_RED + pixel), load(lanes, GRAD_GREEN + pixel)
        grad_blue, grad_depth = load(lanes, GRAD_BLUE + pixel), load(lanes, GRAD_DEPTH + pixel)
        value = grad_red * red + grad_green * green + grad_blue * blue + grad_depth * depth
        if has_features:
            store(lanes, WEIGHT + pixel, weight)
            value += load(lanes, FEATURE_VALUE + pixel)
        behind = load(lanes, BEHIND + pixel) - weight * value
        store(lanes, BEHIND + pixel, behind)
        # d loss / d log(alpha); a clamped alpha does not move
        g = weight * value - alpha * behind / (ONE - alpha)
        g = choose(goes_on, choose(raw <= TOP, g, ZERO), ZERO)
        step_u, step_y = g * u, g * dy
        g0 += g
        gu += step_u
        guu += step_u * u
        gy += step_y
        guy += step_y * u
        gyy += step_y * dy
        sum_red += weight * grad_red
        sum_green += weight * grad_green
        sum_blue += weight * grad_blue
        sum_depth += weight * grad_depth
        abs_x += magnitude(step_u)
        abs_y += magnitude(cross * step_u + along * step_y)
    store_sums(slots, slot + SUM_G, g0, gu, guu, gy)
    store_sums(slots, slot + SUM_GUY, guy, gyy, sum_red, sum_green)
    store_sums(slots, slot + SUM_BLUE, sum_blue, sum_depth, abs_x, abs_y)


@numba.njit(**EXACT)
def _feature_values(lanes: np.ndarray, rows: tuple[int, int], features: np.ndarray) -> None:
    """Features of a Gaussian dotted with the image's feature gradient, pixel by pixel."""
    for pixel in range(rows[0] * TILE_PX, rows[1] * TILE_PX, TILE_PX):
        value = spread(ZERO)
        for channel in range(len(features)):
            gradient = load(lanes, FEATURES + channel * PIXELS + pixel)
            value += gradient * features[channel]
        store(lanes, FEATURE_VALUE + pixel, value)


@numba.njit(**EXACT)
def _feature_sums(
    lanes: np.ndarray, rows: tuple[int, int], sums: np.ndarray, slot: np.ndarray
) -> None:
    for channel in range(len(slot)):
        start = FEATURES + channel * PIXELS
        total = spread(ZERO)
        for pixel in range(rows[0] * TILE_PX, rows[1] * TILE_PX, TILE_PX):
            total += load(lanes, WEIGHT + pixel) * load(lanes, start + pixel)
        store_sums(sums, 0, total, total, total, total)
        slot[channel] = sums[0]


@numba.njit(**EXACT)
def _load_row(lanes: np.ndarray, row: int, place: int, drawn: Images, gradients: Images) -> None:
    """Load a whole tile row from flat images, pixels from a place on."""
    pixel = row * TILE_PX
    store(lanes, LIGHT + pixel, spread(ONE))
    to_red, to_green, to_blue = load_triples(gradients.rgb, 3 * place)
    red, green, blue = load_triples(drawn.rgb, 3 * place)
    to_depth = load(gradients.depth, place)
    store(lanes, GRAD_RED + pixel, to_red)
    store(lanes, GRAD_GREEN + pixel, to_green)
    store(lanes, GRAD_BLUE + pixel, to_blue)
    store(lanes, GRAD_DEPTH + pixel, to_depth)
    total = to_depth * load(drawn.depth, place)
    total -= load(gradients.alpha, place) * load(drawn.light, place)
    store(lanes, BEHIND + pixel, total + to_red * red + to_green * green + to_blue * blue)


@numba.njit(**EXACT)
def _load_part_of_row(
    lanes: np.ndarray, row: int, place: int, columns: int, drawn: Images, gradients: Images
) -> None:
    """Load the first pixels of a tile row that the image's edge cuts."""
    for column in range(columns):
        pixel, k = row * TILE_PX + column, place + column
        lanes[LIGHT + pixel] = ONE
        lanes[GRAD_DEPTH + pixel] = gradients.depth[k]
        total = gradients.depth[k] * drawn.depth[k] - gradients.alpha[k] * drawn.light[k]
        for channel in range(3):
            gradient = gradients.rgb[3 * k + channel]
            lanes[GRAD_RED + channel * PIXELS + pixel] = gradient
            total += gradient * drawn.rgb[3 * k + channel]
        lanes[BEHIND + pixel] = total


@numba.njit(**EXACT)
def _load_features(
    lanes: np.ndarray, row: int, columns: int, drawn: np.ndarray, gradients: np.ndarray
) -> None:
    """Load feature gradients of a tile row; adds what they say about the row's totals."""
    for channel in range(drawn.shape[1]):
        start = FEATURES + channel * PIXELS + row * TILE_PX
        for column in range(columns):
            gradient = gradients[column, channel]
            lanes[start + column] = gradient
            lanes[BEHIND + row * TILE_PX + column] += gradient * drawn[column, channel]


@numba.njit(**EXACT)
def _load_tile(
    corner: tuple[int, int], drawn: Images, gradients: Images, lanes: np.ndarray
) -> None:
    """Pixel gradients, and the gradient-weighted total of what each pixel blended."""
    height, width, channels = drawn.features.shape
    columns = min(TILE_PX, width - corner[0])
    flat, to_flat = flat_images(drawn), flat_images(gradients)
    for row in range(min(TILE_PX, height - corner[1])):
        y = corner[1] + row
        place = y * width + corner[0]
        if columns == TILE_PX:
            _load_row(lanes, row, place, flat, to_flat)
        else:
            _load_part_of_row(lanes, row, place, columns, flat, to_flat)
        if channels:
            end = corner[0] + columns
            own = drawn.features[y, corner[0] : end]
            _load_features(lanes, row, columns, own, gradients.features[y, corner[0] : end])


@numba.njit(**EXACT)
def _walk_tile(
    records: np.ndarray,
    features: np.ndarray,
    lists: TileLists,
    tile: int,
    lanes: np.ndarray,
    slots: np.ndarray,
    feature_slots: np.ndarray,
) -> None:
    corner = (tile % lists.columns * TILE_PX, tile // lists.columns * TILE_PX)
    batch, four = lane_array(BATCH * RECORD_FLOATS), np.empty(4, np.float32)
    has_features = features.shape[1] > 0
    end = lists.tile_first[tile + 1]
    for first in range(lists.tile_first[tile], end, BATCH):
        if not has_light(lanes):
            slots[first * SUMS : end * SUMS] = ZERO
            feature_slots[first:end] = ZERO
            break
        last = fetch_records(records, lists.gaussian, first, end, batch)
        for entry in range(first, last):
            place = (entry - first) * RECORD_FLOATS
            record = batch[place : place + RECORD_FLOATS]
            rows = (first_row_of(lists.reach[entry]), end_row_of(lists.reach[entry]))
            centre = local_centre(record, corner[0], corner[1])
            if has_features:
                _feature_values(lanes, rows, features[lists.gaussian[entry]])
            _entry_sums(lanes, rows, centre, record, has_features, slots, entry * SUMS)
            if has_features:
                _feature_sums(lanes, rows, four, feature_slots[entry])


@compiled_entry
def entry_sums(
    records: np.ndarray, features: np.ndarray, lists: TileLists, drawn: Images, gradients: Images
) -> tuple[np.ndarray, np.ndarray]:
    """Sums over the pixels of each entry of the tile lists.

    `records` are those of `projection.project`, `lists` of `binning.list_tiles`, `drawn` of
    `blending.blend`. The gradient of `light` is not read.

    Returns:
        Sums in the order of the constants above, `SUMS` numbers for each entry, and those
        that make the gradient of the features (entries, features), both float32.
    """
    tiles = lists.columns * lists.rows
    entries, channels = len(lists.gaussian), features.shape[1]
    slots = np.empty(entries * SUMS, np.float32)
    feature_slots = np.empty((entries, channels), np.float32)
    jump = jump_of(tiles)
    for place in numba.prange(tiles):
        tile = place * jump % tiles
        lanes = lane_array(FEATURES + channels * PIXELS)
        lanes[:] = ZERO
        corner = (tile % lists.columns * TILE_PX, tile // lists.columns * TILE_PX)
        _load_tile(corner, drawn, gradients, lanes)
        _walk_tile(records, features, lists, tile, lanes, slots, feature_slots)
    return slots, feature_slots


@numba.njit(**EXACT)
def prefetch_entries(lists: TileLists, index: int, records: np.ndarray, slots: np.ndarray) -> None:
    """Ask for the sums that a later Gaussian will add up: they lie all over the memory."""
    if records[index, IS_VISIBLE] > 0.0:
        for position in range(lists.own[index, 0], lists.own[index, 1]):
            prefetch(slots, np.int64(lists.entry[position]) * SUMS)


@numba.njit(**EXACT)
def add_entries(
    lists: TileLists,
    index: int,
    slots: np.ndarray,
    feature_slots: np.ndarray,
    sums: np.ndarray,
    feature_sums: np.ndarray,
) -> None:
    """Sums of a Gaussian over its entries."""
    for k in range(SUMS):
        sums[k] = 0.0
    for k in range(len(feature_sums)):
        feature_sums[k] = 0.0
    for position in range(lists.own[index, 0], lists.own[index, 1]):
        entry = lists.entry[position]
        slot = np.int64(entry) * SUMS
        for k in range(SUMS):
            sums[k] += slots[slot + k]
        for k in range(len(feature_sums)):
            feature_sums[k] += feature_slots[entry, k]
