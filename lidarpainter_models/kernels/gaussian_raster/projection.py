"""Place Gaussians on the screen: compiled code, one Gaussian at a time, in float64.

The footprint of a Gaussian is that of Zwicker et al. (2001), "EWA splatting": covariance
J W S W^T J^T plus a blur. It is kept in the form

    alpha(x, y) = exp(log_opacity - across (x - mx + shear (y - my))^2 - along (y - my)^2),

which, unlike the inverse covariance, stays exact in float32 for needles, and whose row terms are
shared by all pixels of a row.
"""

import math
from typing import NamedTuple

import numba
import numpy as np

from lidarpainter_models.kernels.gaussian_raster import small_vectors as v3
from lidarpainter_models.kernels.gaussian_raster import spherical_harmonics
from lidarpainter_models.kernels.gaussian_raster.blending_limits import (
    ALPHA_CUT,
    BLUR_PX2,
    COLOUR_OFFSET,
    NEAR_M,
)
from lidarpainter_models.kernels.gaussian_raster.compilation import EXACT, compiled_entry
from lidarpainter_models.kernels.gaussian_raster.small_vectors import Matrix, Quaternion, Vector
from lidarpainter_models.kernels.gaussian_raster.work_sharing import jump_of

RECORD_FLOATS = 16
"""A Gaussian's screen record fills one 64-byte cache line."""

# Columns of a record. Centres are split into a whole and a fraction, so that float32 places them
# to 1e-7 px at any image size.
MEAN_X, MEAN_X_FRACTION, MEAN_Y, MEAN_Y_FRACTION = 0, 1, 2, 3
ACROSS, SHEAR, ALONG, LOG_OPACITY = 4, 5, 6, 7
RED, GREEN, BLUE, DEPTH = 8, 9, 10, 11
HALF_WIDTH, HALF_HEIGHT, SIGMA, IS_VISIBLE = 12, 13, 14, 15

LOG_CUT = math.log(ALPHA_CUT)
LARGEST = 1e30
"""Depths, variances and opacities above this could overflow float32; nothing real comes near."""
CHUNKS = 64
"""Gaussians are shared out in this many runs, whatever the number of threads."""


class Gaussians(NamedTuple):
    """C-contiguous float32 arrays as `Splats` names them, float64 transforms."""

    means: np.ndarray
    rotation_wxyz: np.ndarray
    scale_m: np.ndarray
    opacity: np.ndarray
    sh: np.ndarray
    body_index: np.ndarray
    features: np.ndarray
    camera_from_body: np.ndarray


class View(NamedTuple):
    """The lens of a camera, and the tangents x/z, y/z where projection stays linear."""

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    lowest_x: float
    highest_x: float
    lowest_y: float
    highest_y: float


class Footprint(NamedTuple):
    """One Gaussian between body frame and screen; vectors are tuples (`small_vectors`)."""

    point: Vector
    inverse_z: float
    rotation: Matrix
    translation: Vector
    unit_wxyz: Quaternion
    wxyz_length: float
    from_axes: Matrix
    axes_in_camera: Matrix
    tangent_x: float
    tangent_y: float
    row_x: Vector
    row_y: Vector
    xx: float
    xy: float
    yy: float


@numba.njit(**EXACT)
def transform_of(gaussians: Gaussians, index: int) -> tuple[Matrix, Vector]:
    """Rotation rows and translation of the body a Gaussian belongs to."""
    t = gaussians.camera_from_body[gaussians.body_index[index]]
    rotation = (
        (t[0, 0], t[0, 1], t[0, 2]),
        (t[1, 0], t[1, 1], t[1, 2]),
        (t[2, 0], t[2, 1], t[2, 2]),
    )
    return rotation, (t[0, 3], t[1, 3], t[2, 3])


@numba.njit(**EXACT)
def vector_of(array: np.ndarray, index: int) -> Vector:
    """A row of three as float64."""
    return (
        np.float64(array[index, 0]),
        np.float64(array[index, 1]),
        np.float64(array[index, 2]),
    )


@numba.njit(**EXACT)
def footprint_of(
    gaussians: Gaussians,
    index: int,
    point: Vector,
    rotation: Matrix,
    translation: Vector,
    view: View,
) -> Footprint:
    """Screen covariance of a Gaussian whose centre lies at `point` in the camera frame."""
    q = gaussians.rotation_wxyz[index]
    w, x, y, z = np.float64(q[0]), np.float64(q[1]), np.float64(q[2]), np.float64(q[3])
    length = max(math.sqrt(w * w + x * x + y * y + z * z), 1e-12)
    inverse = 1.0 / length
    unit = (w * inverse, x * inverse, y * inverse, z * inverse)
    scale = vector_of(gaussians.scale_m, index)
    turned = v3.rotation_matrix(unit)
    from_axes = (
        (turned[0][0] * scale[0], turned[0][1] * scale[1], turned[0][2] * scale[2]),
        (turned[1][0] * scale[0], turned[1][1] * scale[1], turned[1][2] * scale[2]),
        (turned[2][0] * scale[0], turned[2][1] * scale[1], turned[2][2] * scale[2]),
    )
    axes = v3.product(rotation, from_axes)
    inverse_z = 1.0 / point[2]
    tangent_x = min(max(point[0] * inverse_z, view.lowest_x), view.highest_x)
    tangent_y = min(max(point[1] * inverse_z, view.lowest_y), view.highest_y)
    row_x = v3.add(axes[0], v3.scaled(axes[2], -tangent_x))
    row_y = v3.add(axes[1], v3.scaled(axes[2], -tangent_y))
    row_x = v3.scaled(row_x, view.fx * inverse_z)
    row_y = v3.scaled(row_y, view.fy * inverse_z)
    return Footprint(
        point,
        inverse_z,
        rotation,
        translation,
        unit,
        length,
        from_axes,
        axes,
        tangent_x,
        tangent_y,
        row_x,
        row_y,
        v3.dot(row_x, row_x) + BLUR_PX2,
        v3.dot(row_x, row_y),
        v3.dot(row_y, row_y) + BLUR_PX2,
    )


@numba.njit(**EXACT)
def view_direction(mean: Vector, rotation: Matrix, translation: Vector) -> Vector:
    """Vector from the camera to a Gaussian in the frame of its body, metres."""
    return v3.add(mean, v3.apply(v3.transposed(rotation), translation))


@numba.njit(**EXACT)
def _write_colour(
    gaussians: Gaussians, index: int, footprint: Footprint, weights: np.ndarray, record: np.ndarray
) -> bool:
    mean = vector_of(gaussians.means, index)
    offset = view_direction(mean, footprint.rotation, footprint.translation)
    direction, _ = v3.direction_of(offset)
    coefficients = gaussians.sh.shape[1]
    spherical_harmonics.basis(coefficients, direction, weights)
    for channel in range(3):
        colour = COLOUR_OFFSET
        for k in range(coefficients):
            colour += weights[k] * gaussians.sh[index, k, channel]
        record[RED + channel] = max(colour, 0.0)
    return math.isfinite(record[RED] + record[GREEN] + record[BLUE])


@numba.njit(**EXACT)
def _write_centre(position: float, record: np.ndarray, column: int) -> None:
    whole = math.floor(position)
    record[column] = whole
    record[column + 1] = position - whole


@numba.njit(**EXACT)
def _write_shape(
    footprint: Footprint, determinant: float, log_opacity: float, record: np.ndarray
) -> None:
    inverse_yy = 1.0 / footprint.yy
    record[ACROSS] = 0.5 * footprint.yy / determinant
    record[SHEAR] = -footprint.xy * inverse_yy
    record[ALONG] = 0.5 * inverse_yy
    record[LOG_OPACITY] = log_opacity
    middle = 0.5 * (footprint.xx + footprint.yy)
    spread = math.sqrt(max(middle * middle - determinant, 0.0))
    record[SIGMA] = math.sqrt(middle + spread)


@numba.njit(**EXACT)
def _write_place(footprint: Footprint, reach: float, view: View, record: np.ndarray) -> bool:
    """Write where a Gaussian lies and how far it reaches; return whether that is in the image."""
    x, y, z = footprint.point
    x = view.fx * x * footprint.inverse_z + view.cx
    y = view.fy * y * footprint.inverse_z + view.cy
    half_width, half_height = math.sqrt(reach * footprint.xx), math.sqrt(reach * footprint.yy)
    record[HALF_WIDTH], record[HALF_HEIGHT], record[DEPTH] = half_width, half_height, z
    _write_centre(x, record, MEAN_X)
    _write_centre(y, record, MEAN_Y)
    inside_x = x + half_width >= 0.5 and x - half_width <= view.width - 0.5
    return inside_x and y + half_height >= 0.5 and y - half_height <= view.height - 0.5


@numba.njit(**EXACT)
def _project_one(
    gaussians: Gaussians, index: int, view: View, weights: np.ndarray, record: np.ndarray
) -> bool:
    """Fill a Gaussian's record; return whether it can reach a pixel."""
    rotation, translation = transform_of(gaussians, index)
    point = v3.add(v3.apply(rotation, vector_of(gaussians.means, index)), translation)
    if not NEAR_M <= point[2] < LARGEST:
        return False
    opacity = np.float64(gaussians.opacity[index])
    if not ALPHA_CUT <= opacity < LARGEST:
        return False
    footprint = footprint_of(gaussians, index, point, rotation, translation, view)
    determinant = footprint.xx * footprint.yy - footprint.xy * footprint.xy
    if not (determinant > 0.0 and footprint.xx + footprint.yy < LARGEST):
        return False
    log_opacity = math.log(opacity)
    reach = 2.0 * (log_opacity - LOG_CUT)
    if not _write_place(footprint, reach, view, record):
        return False
    _write_shape(footprint, determinant, log_opacity, record)
    return _write_colour(gaussians, index, footprint, weights, record)


@numba.njit(**EXACT)
def _project_run(
    gaussians: Gaussians, view: View, first: int, end: int, records: np.ndarray
) -> None:
    weights = np.empty(16)
    for index in range(first, end):
        visible = _project_one(gaussians, index, view, weights, records[index])
        records[index, IS_VISIBLE] = 1.0 if visible else 0.0
        if not visible:
            records[index, SIGMA] = 0.0


@compiled_entry
def project(gaussians: Gaussians, view: View) -> np.ndarray:
    """Screen records of all Gaussians.

    In those that cannot be seen only `IS_VISIBLE` and `SIGMA`, both 0, mean anything.
    """
    count = len(gaussians.means)
    records = np.empty((count, RECORD_FLOATS), np.float32)
    jump = jump_of(CHUNKS)
    for place in numba.prange(CHUNKS):
        run = place * jump % CHUNKS
        first, end = run * count // CHUNKS, (run + 1) * count // CHUNKS
        _project_run(gaussians, view, first, end, records)
    return records
