"""Blend the Gaussians of each screen tile front to back: one program a tile, one lane a pixel.

Pixels are counted from the corner of the tile. A pixel that has stopped keeps its light, negated,
so that it takes nothing more; the tile is left once every pixel has stopped.
"""

import triton
import triton.language as tl

from lidarpainter_models.kernels.gaussian_raster import blending_limits as limits
from lidarpainter_models.kernels.gaussian_raster.triton_kernels import records as screen
from lidarpainter_models.kernels.gaussian_raster.triton_kernels.records import record_of

CUT = tl.constexpr(limits.ALPHA_CUT)
TOP = tl.constexpr(limits.MAX_ALPHA)
STOP = tl.constexpr(limits.MIN_TRANSMITTANCE)
PIXELS = tl.constexpr(limits.TILE_PX**2)
BATCH = tl.constexpr(16)
"""Gaussians between two looks at whether the tile has stopped; a look needs all lanes."""


@triton.jit
def tile_pixels(tile, columns, width, height):
    """Row and column in the tile, place in the image, and whether it lies there, of each lane."""
    lane = tl.arange(0, PIXELS)
    row, column = lane // screen.TILE_PX, lane % screen.TILE_PX
    left, top = tile % columns * screen.TILE_PX, tile // columns * screen.TILE_PX
    inside = (left + column < width) & (top + row < height)
    place = (top + row).to(tl.int64) * width + left + column
    return row, column, place, inside


@triton.jit
def footprint(record, tile, columns, row, column):
    """Offsets (u, dy) in the sheared frame of a footprint, and the alpha before its clamp."""
    left, top = tile % columns * screen.TILE_PX, tile // columns * screen.TILE_PX
    x = (tl.load(record + screen.MEAN_X) - left) + tl.load(record + screen.MEAN_X + 1)
    y = (tl.load(record + screen.MEAN_Y) - top) + tl.load(record + screen.MEAN_Y + 1)
    dy = row.to(tl.float32) + 0.5 - y
    u = column.to(tl.float32) + 0.5 - x + tl.load(record + screen.SHEAR) * dy
    exponent = tl.load(record + screen.LOG_OPACITY) - tl.load(record + screen.ALONG) * dy * dy
    return u, dy, tl.exp(exponent - tl.load(record + screen.ACROSS) * u * u)


@triton.jit
def taken_light(raw, light):
    """Alpha, the weight that a Gaussian gets, who goes on, and the light of each pixel after it."""
    alpha = tl.where(raw >= CUT, tl.minimum(raw, TOP), 0.0)
    weight = light * alpha
    left = light * (1.0 - alpha)  # the difference is exact where alpha comes near its clamp
    goes_on = left >= STOP
    weight = tl.where(goes_on, weight, 0.0)
    return alpha, weight, goes_on, tl.where(goes_on, left, -tl.abs(light))


@triton.jit(do_not_specialize=["width", "height", "columns"])
def blend(
    records,
    features,
    tile_first,
    gaussian,
    rgb,
    depth,
    light_left,
    feature_image,
    width,
    height,
    columns,
    CHANNELS: tl.constexpr,
    ROOM: tl.constexpr,
):
    """Draw a tile: colour, depth, the light that passes all, and features.

    `CHANNELS` features are blended in `ROOM` rows, a power of two.
    """
    tile = tl.program_id(0)
    row, column, place, inside = tile_pixels(tile, columns, width, height)
    light = tl.where(inside, 1.0, 0.0)
    none = tl.zeros([PIXELS], tl.float32)
    red, green, blue, far = none, none, none, none
    channel = tl.arange(0, ROOM)
    blended = tl.zeros([ROOM, PIXELS], tl.float32)
    entry = tl.load(tile_first + tile).to(tl.int64)
    end = tl.load(tile_first + tile + 1).to(tl.int64)
    brightest = tl.max(light, axis=0)
    while (entry < end) & (brightest > 0.0):
        last = tl.minimum(entry + BATCH, end)
        for current in range(entry, last):
            index = tl.load(gaussian + current)
            record = record_of(records, index)
            _, _, raw = footprint(record, tile, columns, row, column)
            _, weight, _, light = taken_light(raw, light)
            red += weight * tl.load(record + screen.RED)
            green += weight * tl.load(record + screen.RED + 1)
            blue += weight * tl.load(record + screen.RED + 2)
            far += weight * tl.load(record + screen.DEPTH)
            if CHANNELS > 0:
                own = features + index.to(tl.int64) * CHANNELS + channel
                value = tl.load(own, mask=channel < CHANNELS, other=0.0)
                blended += value[:, None] * weight[None, :]
        brightest = tl.max(light, axis=0)
        entry = last
    tl.store(rgb + 3 * place, red, mask=inside)
    tl.store(rgb + 3 * place + 1, green, mask=inside)
    tl.store(rgb + 3 * place + 2, blue, mask=inside)
    tl.store(depth + place, far, mask=inside)
    tl.store(light_left + place, tl.abs(light), mask=inside)
    if CHANNELS > 0:
        target = feature_image + place[None, :] * CHANNELS + channel[:, None]
        tl.store(target, blended, mask=inside[None, :] & (channel < CHANNELS)[:, None])
