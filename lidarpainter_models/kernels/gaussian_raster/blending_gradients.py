"""Carry picture gradients back to the Gaussians of each tile: compiled code, float32 lanes.

Tiles are walked front to back once more, with the same early stop as when drawing. What lies
behind a Gaussian is the pixel's total minus what was passed so far, one number per pixel: the
blended value dotted with the picture's gradient. Every (tile, Gaussian) entry writes its own sums,
and each Gaussian adds up its entries in a fixed order, so results do not depend on the threads.
"""

import numba
import numpy as np

from lidarpainter_models.kernels.gaussian_raster.binning import TileLists
from lidarpainter_models.kernels.gaussian_raster.blending import (
    CHECK_EVERY,
    CUT,
    FAR,
    LIGHT,
    ONE,
    PIXEL_X,
    PIXEL_Y,
    PIXELS,
    STOP,
    TOP,
    ZERO,
    Pictures,
    has_light,
    local_centre,
    place_pixels,
    tile_rows_of,
)
from lidarpainter_models.kernels.gaussian_raster.blending_limits import TILE_PX
from lidarpainter_models.kernels.gaussian_raster.compilation import EXACT, LANE_LOOP, compiled_entry
from lidarpainter_models.kernels.gaussian_raster.lane_exponential import lane_exp
from lidarpainter_models.kernels.gaussian_raster.projection import (
    ACROSS,
    ALONG,
    BLUE,
    CHUNKS,
    DEPTH,
    GREEN,
    HALF_HEIGHT,
    LOG_OPACITY,
    RED,
    SHEAR,
)
from lidarpainter_models.kernels.gaussian_raster.work_sharing import jump_of

# Sums over pixels of an entry, with g the gradient of the exponent, u and dy the pixel's offset
# in the sheared frame of the footprint (`projection`).
SUM_G, SUM_GU, SUM_GUU, SUM_GY, SUM_GUY, SUM_GYY = 0, 1, 2, 3, 4, 5
SUM_RED, SUM_GREEN, SUM_BLUE, SUM_DEPTH, SUM_ABS_X, SUM_ABS_Y = 6, 7, 8, 9, 10, 11
SLOT_FLOATS = 12
SUMS = 12

# The work array shares LIGHT, PIXEL_X and PIXEL_Y with drawing.
GRAD_RED, GRAD_GREEN, GRAD_BLUE, GRAD_DEPTH, BEHIND = (
    np.uint64(k * PIXELS) for k in (1, 2, 3, 4, 5)
)
WEIGHT, FEATURE_VALUE = np.uint64(8 * PIXELS), np.uint64(9 * PIXELS)
LANES = 10 * PIXELS
FEATURES = 10 * PIXELS


@numba.njit(**LANE_LOOP)
def _entry_sums(  # noqa: PLR0915 - one loop body; calls would be no clearer
    lanes: np.ndarray,
    first_row: int,
    end_row: int,
    x: float,
    y: float,
    record: np.ndarray,
    slot: np.ndarray,
) -> None:
    """Sums of one Gaussian over rows of a tile; moves the pixels' light and rest along."""
    across, shear, along = record[ACROSS], record[SHEAR], record[ALONG]
    log_opacity = record[LOG_OPACITY]
    red, green, blue, depth = record[RED], record[GREEN], record[BLUE], record[DEPTH]
    cross = across * shear
    g0, gu, guu, gy, guy, gyy = ZERO, ZERO, ZERO, ZERO, ZERO, ZERO
    sum_red, sum_green, sum_blue, sum_depth = ZERO, ZERO, ZERO, ZERO
    abs_x, abs_y = ZERO, ZERO
    for pixel in range(np.uint64(first_row * TILE_PX), np.uint64(end_row * TILE_PX)):
        dy = lanes[PIXEL_Y + pixel] - y
        u = lanes[PIXEL_X + pixel] - x + shear * dy
        raw = lane_exp(max(log_opacity - along * dy * dy - across * u * u, FAR))
        alpha = min(raw, TOP) if raw >= CUT else ZERO
        light = lanes[LIGHT + pixel]
        weight = light * alpha
        left = light - weight
        goes_on = left >= STOP
        weight = weight if goes_on else ZERO
        lanes[LIGHT + pixel] = left if goes_on else -abs(light)
        lanes[WEIGHT + pixel] = weight
        grad_red, grad_green = lanes[GRAD_RED + pixel], lanes[GRAD_GREEN + pixel]
        grad_blue, grad_depth = lanes[GRAD_BLUE + pixel], lanes[GRAD_DEPTH + pixel]
        value = grad_red * red + grad_green * green + grad_blue * blue + grad_depth * depth
        value += lanes[FEATURE_VALUE + pixel]
        behind = lanes[BEHIND + pixel] - weight * value
        lanes[BEHIND + pixel] = behind
        # d loss / d log(alpha); a clamped alpha does not move
        g = weight * value - alpha * behind / (ONE - alpha)
        g = g if goes_on else ZERO
        g = g if raw <= TOP else ZERO
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
        abs_x += abs(step_u)
        abs_y += abs(cross * step_u + along * step_y)
    slot[SUM_G], slot[SUM_GU], slot[SUM_GUU] = g0, gu, guu
    slot[SUM_GY], slot[SUM_GUY], slot[SUM_GYY] = gy, guy, gyy
    slot[SUM_RED], slot[SUM_GREEN], slot[SUM_BLUE] = sum_red, sum_green, sum_blue
    slot[SUM_DEPTH], slot[SUM_ABS_X], slot[SUM_ABS_Y] = sum_depth, abs_x, abs_y


@numba.njit(**LANE_LOOP)
def _feature_values(lanes: np.ndarray, first_row: int, end_row: int, features: np.ndarray) -> None:
    """Features of a Gaussian dotted with the picture's feature gradient, pixel by pixel."""
    for channel in range(len(features)):
        value = features[channel]
        start = np.uint64(FEATURES + channel * PIXELS)
        for pixel in range(np.uint64(first_row * TILE_PX), np.uint64(end_row * TILE_PX)):
            before = lanes[FEATURE_VALUE + pixel] if channel else ZERO
            lanes[FEATURE_VALUE + pixel] = before + lanes[start + pixel] * value


@numba.njit(**LANE_LOOP)
def _feature_sums(lanes: np.ndarray, first_row: int, end_row: int, slot: np.ndarray) -> None:
    for channel in range(len(slot)):
        start = np.uint64(FEATURES + channel * PIXELS)
        total = ZERO
        for pixel in range(np.uint64(first_row * TILE_PX), np.uint64(end_row * TILE_PX)):
            total += lanes[WEIGHT + pixel] * lanes[start + pixel]
        slot[channel] = total


@numba.njit(**EXACT)
def _load_tile(
    tile_x: int, tile_y: int, drawn: Pictures, gradients: Pictures, lanes: np.ndarray
) -> None:
    """Pixel gradients, and the gradient-weighted total of what each pixel blended."""
    height, width, channels = drawn.features.shape
    for row in range(min(TILE_PX, height - tile_y)):
        for column in range(min(TILE_PX, width - tile_x)):
            pixel = row * TILE_PX + column
            y, x = tile_y + row, tile_x + column
            lanes[pixel] = ONE
            total = np.float64(gradients.depth[y, x]) * drawn.depth[y, x]
            total -= np.float64(gradients.alpha[y, x]) * drawn.light[y, x]
            lanes[4 * PIXELS + pixel] = gradients.depth[y, x]
            for channel in range(3):
                gradient = gradients.rgb[y, x, channel]
                lanes[(1 + channel) * PIXELS + pixel] = gradient
                total += np.float64(gradient) * drawn.rgb[y, x, channel]
            for channel in range(channels):
                gradient = gradients.features[y, x, channel]
                lanes[FEATURES + channel * PIXELS + pixel] = gradient
                total += np.float64(gradient) * drawn.features[y, x, channel]
            lanes[BEHIND + np.uint64(pixel)] = total


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
    tile_x, tile_y = tile % lists.columns * TILE_PX, tile // lists.columns * TILE_PX
    first, end = lists.tile_first[tile], lists.tile_first[tile + 1]
    for entry in range(first, end):
        if (entry - first) % CHECK_EVERY == CHECK_EVERY - 1 and not has_light(lanes):
            slots[entry:end] = ZERO
            feature_slots[entry:end] = ZERO
            break
        index = lists.gaussian[entry]
        record = records[index]
        x, y = local_centre(record, tile_x, tile_y)
        first_row, end_row = tile_rows_of(y, record[HALF_HEIGHT])
        if features.shape[1]:
            _feature_values(lanes, first_row, end_row, features[index])
        _entry_sums(lanes, first_row, end_row, x, y, record, slots[entry])
        if features.shape[1]:
            _feature_sums(lanes, first_row, end_row, feature_slots[entry])


@numba.njit(**EXACT)
def _tile_sums(
    records: np.ndarray,
    features: np.ndarray,
    lists: TileLists,
    tile: int,
    pictures: tuple[Pictures, Pictures],
    slots: tuple[np.ndarray, np.ndarray],
) -> None:
    tile_x, tile_y = tile % lists.columns * TILE_PX, tile // lists.columns * TILE_PX
    lanes = np.zeros(LANES + features.shape[1] * PIXELS, np.float32)
    place_pixels(lanes)
    _load_tile(tile_x, tile_y, pictures[0], pictures[1], lanes)
    _walk_tile(records, features, lists, tile, lanes, slots[0], slots[1])


@numba.njit(**EXACT)
def _add_entries(
    lists: TileLists,
    slots: np.ndarray,
    feature_slots: np.ndarray,
    first: int,
    end: int,
    sums: np.ndarray,
    feature_sums: np.ndarray,
) -> None:
    for place in range(first, end):
        index = lists.order[place]
        for position in range(lists.entry_first[place], lists.entry_first[place + 1]):
            entry = lists.entry[position]
            for k in range(SLOT_FLOATS):
                sums[index, k] += slots[entry, k]
            for k in range(feature_slots.shape[1]):
                feature_sums[index, k] += feature_slots[entry, k]


@compiled_entry
def gaussian_sums(
    records: np.ndarray,
    features: np.ndarray,
    lists: TileLists,
    drawn: Pictures,
    gradients: Pictures,
) -> tuple[np.ndarray, np.ndarray]:
    """Sums over all pixels of each Gaussian.

    Args:
        records: from `projection.project`.
        features: of the Gaussians, float32.
        lists: from `binning.list_tiles`.
        drawn: from `blending.blend`.
        gradients: of the loss with respect to each picture; that of `light` is not read.

    Returns:
        Sums (gaussians, `SUMS`) in the order of the constants above, and the gradient of the
        features, both float64.
    """
    tiles = lists.columns * lists.rows
    entries, channels = len(lists.gaussian), features.shape[1]
    slots = np.empty((entries, SLOT_FLOATS), np.float32)
    feature_slots = np.empty((entries, channels), np.float32)
    jump = jump_of(tiles)
    for place in numba.prange(tiles):
        tile = place * jump % tiles
        _tile_sums(records, features, lists, tile, (drawn, gradients), (slots, feature_slots))
    sums = np.zeros((len(records), SUMS), np.float64)
    feature_sums = np.zeros((len(records), channels), np.float64)
    visible = len(lists.order)
    jump = jump_of(CHUNKS)
    for place in numba.prange(CHUNKS):
        run = place * jump % CHUNKS
        first, end = run * visible // CHUNKS, (run + 1) * visible // CHUNKS
        _add_entries(lists, slots, feature_slots, first, end, sums, feature_sums)
    return sums, feature_sums
