"""The screen record of a Gaussian, sixteen float32 in 64 bytes, and the tiles that it may reach.

Columns are those of the numba backend's `projection`: the centre as whole and fraction, so that
float32 places it to 1e-7 px in an image of any size, and the footprint

    alpha(x, y) = exp(log_opacity - across (x - mx + shear (y - my))^2 - along (y - my)^2).
"""

import triton
import triton.language as tl

from lidarpainter_models.kernels.gaussian_raster import blending_limits as limits
from lidarpainter_models.kernels.gaussian_raster.screen_ellipses import ROUNDING_PX as SLACK_PX

FLOATS = tl.constexpr(16)
MEAN_X, MEAN_Y, ACROSS, SHEAR, ALONG, LOG_OPACITY = map(tl.constexpr, (0, 2, 4, 5, 6, 7))
RED, DEPTH, HALF_WIDTH, HALF_HEIGHT, IS_VISIBLE = map(tl.constexpr, (8, 11, 12, 13, 15))

TILE_PX = tl.constexpr(limits.TILE_PX)
ROUNDING_PX = tl.constexpr(SLACK_PX)


@triton.jit
def record_of(records, index):
    """Where the records of Gaussians begin."""
    return records + index.to(tl.int64) * FLOATS


@triton.jit
def load_place(record, mask):
    """Projected centres and half bounding boxes (x, y, width, height), pixels, float64."""
    x = tl.load(record + MEAN_X, mask=mask, other=0.0).to(tl.float64)
    y = tl.load(record + MEAN_Y, mask=mask, other=0.0).to(tl.float64)
    x += tl.load(record + MEAN_X + 1, mask=mask, other=0.0)
    y += tl.load(record + MEAN_Y + 1, mask=mask, other=0.0)
    half_width = tl.load(record + HALF_WIDTH, mask=mask, other=0.0).to(tl.float64)
    half_height = tl.load(record + HALF_HEIGHT, mask=mask, other=0.0).to(tl.float64)
    return x, y, half_width, half_height


@triton.jit
def tile_span(low_px, high_px, tiles):
    """First and one past the last tile whose pixel centres lie between two positions."""
    limit_px = (tiles * TILE_PX).to(tl.float64)
    first = tl.ceil(tl.minimum(tl.maximum(low_px - ROUNDING_PX, 0.0), limit_px) - 0.5)
    last = tl.floor(tl.maximum(tl.minimum(high_px + ROUNDING_PX, limit_px), 0.0) - 0.5)
    first = first.to(tl.int32) // TILE_PX
    # the pixel before the first has the tile before the first
    last = (last.to(tl.int32) + TILE_PX) // TILE_PX - 1
    return first, tl.minimum(last + 1, tiles)


@triton.jit
def tile_box(place, columns, rows):
    """Tile columns and rows (first, end, first, end) that bounding boxes cover."""
    x, y, half_width, half_height = place
    first_column, end_column = tile_span(x - half_width, x + half_width, columns)
    first_row, end_row = tile_span(y - half_height, y + half_height, rows)
    return first_column, end_column, first_row, end_row
