"""Place Gaussians on the screen: compiled code, eight Gaussians at a time, in float64.

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
from lidarpainter_models.kernels.gaussian_raster.compilation import EXACT, compiled_entry, jump_of
from lidarpainter_models.kernels.gaussian_raster.gaussian_lanes import (
    EIGHT,
    Rows,
    in_all,
    lanes_at,
    pick,
    put,
    rows_of,
    transforms_of,
    vector_of,
)
from lidarpainter_models.kernels.gaussian_raster.lane_types import (
    any_of,
    choose,
    largest,
    magnitude,
    rounded_down,
    smallest,
)
from lidarpainter_models.kernels.gaussian_raster.small_vectors import Matrix, Quaternion, Vector

RECORD_FLOATS = 16
"""A Gaussian's screen record fills one 64-byte cache line."""

# Columns of a record. Centres are split into a whole and a fraction, so that float32 places them
# to 1e-7 px at any image size.
MEAN_X, MEAN_X_FRACTION, MEAN_Y, MEAN_Y_FRACTION = 0, 1, 2, 3
ACROSS, SHEAR, ALONG, LOG_OPACITY = 4, 5, 6, 7
RED, GREEN, BLUE, DEPTH = 8, 9, 10, 11
HALF_WIDTH, HALF_HEIGHT, IS_VISIBLE = 12, 13, 15

LOG_CUT = math.log(ALPHA_CUT)
LARGEST = 1e30
"""Depths, variances and opacities above this could overflow float32; nothing real comes near."""
CHUNKS = 64
"""Gaussians are shared out in this many runs, whatever the number of threads."""


class Gaussians(NamedTuple):
    """C-contiguous float32 arrays as `Splats` names them, float64 transforms, int32 bodies."""

    means: np.ndarray
    rotation_wxyz: np.ndarray
    scale_m: np.ndarray
    opacity: np.ndarray
    sh: np.ndarray
    features: np.ndarray
    camera_from_body: np.ndarray
    body_index: np.ndarray


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
    """Eight Gaussians between body frame and screen, as lanes; vectors are tuples of them."""

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
def footprint_of(
    gaussians: Gaussians,
    rows: Rows,
    point: Vector,
    rotation: Matrix,
    translation: Vector,
    view: View,
) -> Footprint:
    """Screen covariances of Gaussians whose centres lie at `point` in the camera frame."""
    q, places = gaussians.rotation_wxyz, rows.places
    w, x = pick(q, places, 4, 0), pick(q, places, 4, 1)
    y, z = pick(q, places, 4, 2), pick(q, places, 4, 3)
    length = largest(math.sqrt(w * w + x * x + y * y + z * z), 1e-12)
    inverse = 1.0 / length
    unit = (w * inverse, x * inverse, y * inverse, z * inverse)
    scale = vector_of(gaussians.scale_m, rows)
    turned = v3.rotation_matrix(unit)
    from_axes = (
        (turned[0][0] * scale[0], turned[0][1] * scale[1], turned[0][2] * scale[2]),
        (turned[1][0] * scale[0], turned[1][1] * scale[1], turned[1][2] * scale[2]),
        (turned[2][0] * scale[0], turned[2][1] * scale[1], turned[2][2] * scale[2]),
    )
    axes = v3.product(rotation, from_axes)
    inverse_z = 1.0 / point[2]
    tangent_x = smallest(largest(point[0] * inverse_z, view.lowest_x), view.highest_x)
    tangent_y = smallest(largest(point[1] * inverse_z, view.lowest_y), view.highest_y)
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
def _write(records: np.ndarray, rows: Rows, column: int, value: float) -> None:
    put(records, rows.places, RECORD_FLOATS, column, value)


@numba.njit(**EXACT)
def _write_colour(
    gaussians: Gaussians, rows: Rows, footprint: Footprint, weights: np.ndarray, records: np.ndarray
) -> float:
    """Write colours; return by how much they are off black, before they are cut off there."""
    mean = vector_of(gaussians.means, rows)
    offset = view_direction(mean, footprint.rotation, footprint.translation)
    direction, _ = v3.direction_of(offset)
    coefficients = gaussians.sh.shape[1]
    spherical_harmonics.basis(coefficients, direction, weights)
    extent = in_all(0.0)
    for channel in range(3):
        colour = in_all(COLOUR_OFFSET)
        for k in range(coefficients):
            harmonic = pick(gaussians.sh, rows.places, 3 * coefficients, 3 * k + channel)
            colour += lanes_at(weights, k) * harmonic
        extent += magnitude(colour)
        _write(records, rows, RED + channel, largest(colour, 0.0))
    return extent


@numba.njit(**EXACT)
def _write_centre(position: float, records: np.ndarray, rows: Rows, column: int) -> None:
    whole = rounded_down(position)
    _write(records, rows, column, whole)
    _write(records, rows, column + 1, position - whole)


@numba.njit(**EXACT)
def _write_shape(
    footprint: Footprint, determinant: float, log_opacity: float, records: np.ndarray, rows: Rows
) -> None:
    """Write the footprint's form."""
    inverse_yy = 1.0 / footprint.yy
    _write(records, rows, ACROSS, 0.5 * footprint.yy / determinant)
    _write(records, rows, SHEAR, -footprint.xy * inverse_yy)
    _write(records, rows, ALONG, 0.5 * inverse_yy)
    _write(records, rows, LOG_OPACITY, log_opacity)


@numba.njit(**EXACT)
def _write_place(
    footprint: Footprint, reach: float, view: View, records: np.ndarray, rows: Rows
) -> bool:
    """Write where Gaussians lie and how far they reach; return whether that is in the image."""
    x, y, z = footprint.point
    x = view.fx * x * footprint.inverse_z + view.cx
    y = view.fy * y * footprint.inverse_z + view.cy
    half_width, half_height = math.sqrt(reach * footprint.xx), math.sqrt(reach * footprint.yy)
    _write(records, rows, HALF_WIDTH, half_width)
    _write(records, rows, HALF_HEIGHT, half_height)
    _write(records, rows, DEPTH, z)
    _write_centre(x, records, rows, MEAN_X)
    _write_centre(y, records, rows, MEAN_Y)
    is_inside = (x + half_width >= 0.5) & (x - half_width <= view.width - 0.5)
    return is_inside & (y + half_height >= 0.5) & (y - half_height <= view.height - 0.5)


@numba.njit(**EXACT)
def _hide(records: np.ndarray, rows: Rows) -> None:
    for place in rows.places:
        records[place, IS_VISIBLE] = 0.0


@numba.njit(**EXACT)
def _project_eight(
    gaussians: Gaussians,
    rows: Rows,
    of_one_body: bool,
    view: View,
    weights: np.ndarray,
    records: np.ndarray,
) -> None:
    """Fill the records of eight Gaussians, visible where they can reach a pixel."""
    rotation, translation = transforms_of(gaussians.camera_from_body, rows, of_one_body)
    point = v3.add(v3.apply(rotation, vector_of(gaussians.means, rows)), translation)
    opacity = pick(gaussians.opacity, rows.places, 1, 0)
    visible = (point[2] >= NEAR_M) & (point[2] < LARGEST)
    visible = visible & (opacity >= ALPHA_CUT) & (opacity < LARGEST)
    if not any_of(visible):
        _hide(records, rows)
        return
    log_opacity = math.log(choose(visible, opacity, 1.0))
    footprint = footprint_of(gaussians, rows, point, rotation, translation, view)
    determinant = footprint.xx * footprint.yy - footprint.xy * footprint.xy
    visible = visible & (determinant > 0.0) & (footprint.xx + footprint.yy < LARGEST)
    reach = 2.0 * (log_opacity - LOG_CUT)
    visible = visible & _write_place(footprint, reach, view, records, rows)
    if not any_of(visible):
        _hide(records, rows)
        return
    _write_shape(footprint, determinant, log_opacity, records, rows)
    visible = visible & (_write_colour(gaussians, rows, footprint, weights, records) < LARGEST)
    _write(records, rows, IS_VISIBLE, choose(visible, 1.0, 0.0))


@numba.njit(**EXACT)
def _project_run(
    gaussians: Gaussians, view: View, first: int, end: int, records: np.ndarray
) -> None:
    weights = np.empty(16 * EIGHT)
    rows = Rows(np.empty(EIGHT, np.int64), np.empty(EIGHT, np.int64))
    for start in range(first, end, EIGHT):
        of_one_body = rows_of(gaussians.body_index, start, end, rows)
        _project_eight(gaussians, rows, of_one_body, view, weights, records)


@compiled_entry
def project(gaussians: Gaussians, view: View) -> np.ndarray:
    """Screen records of all Gaussians.

    In those that cannot be seen only `IS_VISIBLE`, 0, means anything.
    """
    count = len(gaussians.means)
    records = np.empty((count, RECORD_FLOATS), np.float32)
    jump = jump_of(CHUNKS)
    for place in numba.prange(CHUNKS):
        run = place * jump % CHUNKS
        first, end = run * count // CHUNKS, (run + 1) * count // CHUNKS
        _project_run(gaussians, view, first, end, records)
    return records
