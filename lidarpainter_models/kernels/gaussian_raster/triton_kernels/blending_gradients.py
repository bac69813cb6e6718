"""Carry image gradients back to the Gaussians of each tile, and add them up for each Gaussian.

Tiles are walked front to back once more, as in the numba `blending_gradients`: what lies behind a
Gaussian is the pixel's total minus what was passed so far. Each entry of the lists writes its own
sums, and each Gaussian adds up its entries in a fixed order: no atomics, equal bits from run to
run.
"""

import triton
import triton.language as tl

from lidarpainter_models.kernels.gaussian_raster.triton_kernels.blending import (
    BATCH,
    PIXELS,
    TOP,
    footprint,
    taken_light,
    tile_pixels,
)
from lidarpainter_models.kernels.gaussian_raster.triton_kernels.records import (
    ACROSS,
    ALONG,
    DEPTH,
    RED,
    SHEAR,
    record_of,
)

# places of an entry's sums in its slot: see the numba `blending_gradients`
SUM_G, SUM_GU, SUM_GUU, SUM_GY, SUM_GUY, SUM_GYY = map(tl.constexpr, range(6))
SUM_RED, SUM_DEPTH, SUM_ABS_X, SUM_ABS_Y = map(tl.constexpr, (6, 9, 10, 11))
SLOT = tl.constexpr(16)
"""Room of an entry's sums: 64 bytes."""


@triton.jit(do_not_specialize=["width", "height", "columns"])
def entry_sums(
    records,
    features,
    tile_first,
    gaussian,
    rgb,
    depth,
    light_left,
    feature_image,
    to_rgb,
    to_depth,
    to_alpha,
    to_features,
    slots,
    feature_slots,
    width,
    height,
    columns,
    CHANNELS: tl.constexpr,
    ROOM: tl.constexpr,
):
    """Sums over the pixels of a tile for each of its entries.

    The images drawn and the gradients with respect to them go in; entries behind the last light
    are not written and must hold zeros.
    """
    tile = tl.program_id(0)
    row, column, place, inside = tile_pixels(tile, columns, width, height)
    to_red = tl.load(to_rgb + 3 * place, mask=inside, other=0.0)
    to_green = tl.load(to_rgb + 3 * place + 1, mask=inside, other=0.0)
    to_blue = tl.load(to_rgb + 3 * place + 2, mask=inside, other=0.0)
    to_far = tl.load(to_depth + place, mask=inside, other=0.0)
    behind = to_far * tl.load(depth + place, mask=inside, other=0.0)
    behind -= tl.load(to_alpha + place, mask=inside, other=0.0) * tl.load(
        light_left + place, mask=inside, other=0.0
    )
    behind += to_red * tl.load(rgb + 3 * place, mask=inside, other=0.0)
    behind += to_green * tl.load(rgb + 3 * place + 1, mask=inside, other=0.0)
    behind += to_blue * tl.load(rgb + 3 * place + 2, mask=inside, other=0.0)
    channel = tl.arange(0, ROOM)
    to_blended = tl.zeros([ROOM, PIXELS], tl.float32)
    if CHANNELS > 0:
        both = inside[None, :] & (channel < CHANNELS)[:, None]
        offset = place[None, :] * CHANNELS + channel[:, None]
        to_blended = tl.load(to_features + offset, mask=both, other=0.0)
        drawn = tl.load(feature_image + offset, mask=both, other=0.0)
        behind += tl.sum(to_blended * drawn, axis=0)
    light = tl.where(inside, 1.0, 0.0)
    entry = tl.load(tile_first + tile).to(tl.int64)
    end = tl.load(tile_first + tile + 1).to(tl.int64)
    brightest = tl.max(light, axis=0)
    while (entry < end) & (brightest > 0.0):
        last = tl.minimum(entry + BATCH, end)
        for current in range(entry, last):
            index = tl.load(gaussian + current)
            record = record_of(records, index)
            u, dy, raw = footprint(record, tile, columns, row, column)
            alpha, weight, goes_on, light = taken_light(raw, light)
            value = to_red * tl.load(record + RED) + to_green * tl.load(record + RED + 1)
            value += to_blue * tl.load(record + RED + 2) + to_far * tl.load(record + DEPTH)
            if CHANNELS > 0:
                own = features + index.to(tl.int64) * CHANNELS + channel
                feature = tl.load(own, mask=channel < CHANNELS, other=0.0)
                value += tl.sum(feature[:, None] * to_blended, axis=0)
                target = feature_slots + current * CHANNELS + channel
                sums = tl.sum(to_blended * weight[None, :], axis=1)
                tl.store(target, sums, mask=channel < CHANNELS)
            behind -= weight * value
            # d loss / d log(alpha); a clamped alpha does not move
            g = weight * value - alpha * behind / (1.0 - alpha)
            g = tl.where(goes_on & (raw <= TOP), g, 0.0)
            gu, gy = g * u, g * dy
            slot = slots + current * SLOT
            tl.store(slot + SUM_G, tl.sum(g, axis=0))
            tl.store(slot + SUM_GU, tl.sum(gu, axis=0))
            tl.store(slot + SUM_GUU, tl.sum(gu * u, axis=0))
            tl.store(slot + SUM_GY, tl.sum(gy, axis=0))
            tl.store(slot + SUM_GUY, tl.sum(gy * u, axis=0))
            tl.store(slot + SUM_GYY, tl.sum(gy * dy, axis=0))
            tl.store(slot + SUM_RED, tl.sum(weight * to_red, axis=0))
            tl.store(slot + SUM_RED + 1, tl.sum(weight * to_green, axis=0))
            tl.store(slot + SUM_RED + 2, tl.sum(weight * to_blue, axis=0))
            tl.store(slot + SUM_DEPTH, tl.sum(weight * to_far, axis=0))
            across, along = tl.load(record + ACROSS), tl.load(record + ALONG)
            step_y = across * tl.load(record + SHEAR) * gu + along * gy
            tl.store(slot + SUM_ABS_X, tl.sum(tl.abs(gu), axis=0))
            tl.store(slot + SUM_ABS_Y, tl.sum(tl.abs(step_y), axis=0))
        brightest = tl.max(light, axis=0)
        entry = last


@triton.jit
def gaussian_sums(
    first_pair,
    entry_of_pair,
    slots,
    feature_slots,
    sums,
    to_features,
    CHANNELS: tl.constexpr,
    ROOM: tl.constexpr,
    ENTRIES: tl.constexpr,
):
    """Add up the entries of a Gaussian, `ENTRIES` at a time; features are added to `to_features`.

    `first_pair` also ends the last Gaussian's; sums are float64, `SLOT` for each Gaussian.
    """
    gaussian = tl.program_id(0).to(tl.int64)
    pair, end = tl.load(first_pair + gaussian), tl.load(first_pair + gaussian + 1)
    lane, number, channel = tl.arange(0, ENTRIES), tl.arange(0, SLOT), tl.arange(0, ROOM)
    total = tl.zeros([SLOT], tl.float64)
    feature_total = tl.zeros([ROOM], tl.float64)
    while pair < end:
        exists = pair + lane < end
        entry = tl.load(entry_of_pair + pair + lane, mask=exists, other=0).to(tl.int64)
        found = tl.load(
            slots + entry[:, None] * SLOT + number[None, :], mask=exists[:, None], other=0.0
        )
        total += tl.sum(found.to(tl.float64), axis=0)
        if CHANNELS > 0:
            both = exists[:, None] & (channel < CHANNELS)[None, :]
            offset = entry[:, None] * CHANNELS + channel[None, :]
            values = tl.load(feature_slots + offset, mask=both, other=0.0)
            feature_total += tl.sum(values.to(tl.float64), axis=0)
        pair += ENTRIES
    tl.store(sums + gaussian * SLOT + number, total)
    if CHANNELS > 0:
        own = to_features + gaussian * CHANNELS + channel
        before = tl.load(own, mask=channel < CHANNELS, other=0.0)
        tl.store(own, before + feature_total.to(tl.float32), mask=channel < CHANNELS)
