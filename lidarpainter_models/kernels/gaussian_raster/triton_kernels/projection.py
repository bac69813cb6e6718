"""Place Gaussians on the screen, one lane each, in float64; the same as the numba `projection`."""

import math

import triton
import triton.language as tl

from lidarpainter_models.kernels.gaussian_raster import blending_limits as limits
from lidarpainter_models.kernels.gaussian_raster import projection as numba_projection
from lidarpainter_models.kernels.gaussian_raster.triton_kernels import records as screen
from lidarpainter_models.kernels.gaussian_raster.triton_kernels import vectors as v3
from lidarpainter_models.kernels.gaussian_raster.triton_kernels.harmonics import basis
from lidarpainter_models.kernels.gaussian_raster.triton_kernels.records import record_of, tile_box

NEAR_M = tl.constexpr(limits.NEAR_M)
CUT = tl.constexpr(limits.ALPHA_CUT)
LOG_CUT = tl.constexpr(math.log(limits.ALPHA_CUT))
BLUR_PX2 = tl.constexpr(limits.BLUR_PX2)
COLOUR_OFFSET = tl.constexpr(limits.COLOUR_OFFSET)
LARGEST = tl.constexpr(numba_projection.LARGEST)
SHORTEST = tl.constexpr(1e-12)


@triton.jit
def load_lens(lens):
    """Focal lengths, principal point, and the tangents within which projection stays linear."""
    return (
        tl.load(lens),
        tl.load(lens + 1),
        tl.load(lens + 2),
        tl.load(lens + 3),
        tl.load(lens + 4),
        tl.load(lens + 5),
        tl.load(lens + 6),
        tl.load(lens + 7),
    )


@triton.jit
def load_quaternion(rotation_wxyz, index, mask):
    """Unit quaternions and the lengths they were divided by, float64."""
    start = rotation_wxyz + 4 * index.to(tl.int64)
    w = tl.load(start, mask=mask, other=1.0).to(tl.float64)
    x = tl.load(start + 1, mask=mask, other=0.0).to(tl.float64)
    y = tl.load(start + 2, mask=mask, other=0.0).to(tl.float64)
    z = tl.load(start + 3, mask=mask, other=0.0).to(tl.float64)
    length = tl.maximum(tl.sqrt(w * w + x * x + y * y + z * z), SHORTEST)
    inverse = 1.0 / length
    return (w * inverse, x * inverse, y * inverse, z * inverse), length


@triton.jit
def body_axes(quaternion, scale):
    """Rotation times scale: the Gaussian's axes in the frame of its body, as columns."""
    turned = v3.rotation_matrix(quaternion[0], quaternion[1], quaternion[2], quaternion[3])
    return (
        (turned[0][0] * scale[0], turned[0][1] * scale[1], turned[0][2] * scale[2]),
        (turned[1][0] * scale[0], turned[1][1] * scale[1], turned[1][2] * scale[2]),
        (turned[2][0] * scale[0], turned[2][1] * scale[1], turned[2][2] * scale[2]),
    )


@triton.jit
def screen_rows(axes, point, lens):
    """The axes on the screen, pixels (a row for x, one for y), and the tangents they use."""
    inverse_z = 1.0 / point[2]
    tangent_x = tl.minimum(tl.maximum(point[0] * inverse_z, lens[4]), lens[5])
    tangent_y = tl.minimum(tl.maximum(point[1] * inverse_z, lens[6]), lens[7])
    row_x = v3.scaled(v3.add(axes[0], v3.scaled(axes[2], -tangent_x)), lens[0] * inverse_z)
    row_y = v3.scaled(v3.add(axes[1], v3.scaled(axes[2], -tangent_y)), lens[1] * inverse_z)
    return row_x, row_y, tangent_x, tangent_y


@triton.jit
def view_direction(mean, rotation, translation):
    """Unit vectors from the camera to centres in the frame of their body, and lengths, metres."""
    offset = v3.add(mean, v3.apply(v3.transposed(rotation), translation))
    length = tl.maximum(tl.sqrt(v3.dot(offset, offset)), SHORTEST)
    return v3.scaled(offset, 1.0 / length), length


@triton.jit
def _write(record, value, mask):
    """Store float64 as float32; return what was stored."""
    stored = value.to(tl.float32)
    tl.store(record, stored, mask=mask)
    return stored.to(tl.float64)


@triton.jit
def _write_centre(record, position, mask):
    whole = tl.floor(position)
    return _write(record, whole, mask) + _write(record + 1, position - whole, mask)


@triton.jit
def _write_colour(record, direction, sh, index, mask, COEFFICIENTS: tl.constexpr):
    """Write colours; return which are finite."""
    weights = basis(direction[0], direction[1], direction[2])
    start = sh + index.to(tl.int64) * (3 * COEFFICIENTS)
    total = 0.0 * direction[0]
    for channel in tl.static_range(3):
        colour = 0.0 * direction[0] + COLOUR_OFFSET
        for k in tl.static_range(COEFFICIENTS):
            colour += weights[k] * tl.load(start + 3 * k + channel, mask=mask, other=0.0)
        total += colour  # not a number stays so here, where the maximum may drop it
        _write(record + screen.RED + channel, tl.maximum(colour, 0.0), mask)
    return tl.abs(total) < LARGEST


@triton.jit
def _write_shape(record, xx, xy, yy, opacity, mask):
    """Write the footprint and how far it reaches; return half its bounding box, pixels."""
    determinant = xx * yy - xy * xy
    log_opacity = tl.log(opacity)
    reach = tl.maximum(2.0 * (log_opacity - LOG_CUT), 0.0)
    _write(record + screen.ACROSS, 0.5 * yy / determinant, mask)
    _write(record + screen.SHEAR, -xy / yy, mask)
    _write(record + screen.ALONG, 0.5 / yy, mask)
    _write(record + screen.LOG_OPACITY, log_opacity, mask)
    half_width = _write(record + screen.HALF_WIDTH, tl.sqrt(reach * xx), mask)
    return half_width, _write(record + screen.HALF_HEIGHT, tl.sqrt(reach * yy), mask)


@triton.jit(do_not_specialize=["count", "width", "height"])
def project(
    means,
    rotation_wxyz,
    scale_m,
    opacity,
    sh,
    body_index,
    camera_from_body,
    lens,
    records,
    tile_count,
    count,
    width,
    height,
    COEFFICIENTS: tl.constexpr,
    BLOCK: tl.constexpr,
):
    """Write the records of Gaussians, and how many tiles their bounding boxes cover.

    In records that cannot be seen only `IS_VISIBLE`, 0, means anything.
    """
    index = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    exists = index < count
    record = record_of(records, index)
    optics = load_lens(lens)
    body = tl.load(body_index + index, mask=exists, other=0)
    rotation, translation = v3.load_pose(camera_from_body, body, exists)
    mean = v3.load_vector(means, index, exists, 0.0)
    point = v3.add(v3.apply(rotation, mean), translation)
    opaque = tl.load(opacity + index, mask=exists, other=0.0).to(tl.float64)
    seen = exists & (point[2] >= NEAR_M) & (point[2] < LARGEST)
    seen = seen & (opaque >= CUT) & (opaque < LARGEST)
    # from here on a lane that is not seen computes something finite that nobody reads
    point = (
        tl.where(seen, point[0], 0.0),
        tl.where(seen, point[1], 0.0),
        tl.where(seen, point[2], 1.0),
    )
    opaque = tl.where(seen, opaque, 1.0)
    scale = v3.load_vector(scale_m, index, seen, 1.0)
    quaternion, _ = load_quaternion(rotation_wxyz, index, seen)
    axes = v3.product(rotation, body_axes(quaternion, scale))
    row_x, row_y, _, _ = screen_rows(axes, point, optics)
    xx, yy = v3.dot(row_x, row_x) + BLUR_PX2, v3.dot(row_y, row_y) + BLUR_PX2
    xy = v3.dot(row_x, row_y)
    seen = seen & (xx * yy - xy * xy > 0.0) & (xx + yy < LARGEST)
    xx, xy, yy = tl.where(seen, xx, 1.0), tl.where(seen, xy, 0.0), tl.where(seen, yy, 1.0)
    half_width, half_height = _write_shape(record, xx, xy, yy, opaque, seen)
    x = _write_centre(record + screen.MEAN_X, optics[0] * point[0] / point[2] + optics[2], seen)
    y = _write_centre(record + screen.MEAN_Y, optics[1] * point[1] / point[2] + optics[3], seen)
    seen = seen & (x + half_width >= 0.5) & (x - half_width <= width - 0.5)
    seen = seen & (y + half_height >= 0.5) & (y - half_height <= height - 0.5)
    _write(record + screen.DEPTH, point[2], seen)
    direction, _ = view_direction(mean, rotation, translation)
    seen = seen & _write_colour(record, direction, sh, index, seen, COEFFICIENTS)
    tl.store(record + screen.IS_VISIBLE, tl.where(seen, 1.0, 0.0), mask=exists)
    columns, rows = tl.cdiv(width, screen.TILE_PX), tl.cdiv(height, screen.TILE_PX)
    box = tile_box((x, y, half_width, half_height), columns, rows)
    tiles = (box[1] - box[0]) * (box[3] - box[2])
    tl.store(tile_count + index, tl.where(seen, tiles, 0), mask=exists)
