"""Carry screen gradients back through the projection: compiled code, one Gaussian at a time.

Each Gaussian first adds up the sums of its entries, tiles in reading order. The projection is
computed again rather than kept. Everything is float64; the gradient of `camera_from_body` is summed
over fixed runs of Gaussians and then over runs, in order, so it does not depend on the number of
threads.
"""

import math
from typing import NamedTuple

import numba
import numpy as np

from lidarpainter_models.kernels.gaussian_raster import small_vectors as v3
from lidarpainter_models.kernels.gaussian_raster import spherical_harmonics
from lidarpainter_models.kernels.gaussian_raster.binning import TileLists
from lidarpainter_models.kernels.gaussian_raster.blending_gradients import (
    SUM_ABS_X,
    SUM_ABS_Y,
    SUM_DEPTH,
    SUM_G,
    SUM_GU,
    SUM_GUU,
    SUM_GUY,
    SUM_GY,
    SUM_GYY,
    SUM_RED,
    SUMS,
    add_entries,
    prefetch_entries,
)
from lidarpainter_models.kernels.gaussian_raster.compilation import EXACT, compiled_entry
from lidarpainter_models.kernels.gaussian_raster.projection import (
    ACROSS,
    ALONG,
    CHUNKS,
    IS_VISIBLE,
    RED,
    SHEAR,
    Footprint,
    Gaussians,
    View,
    footprint_of,
    transform_of,
    vector_of,
    view_direction,
)
from lidarpainter_models.kernels.gaussian_raster.small_vectors import Matrix, Vector
from lidarpainter_models.kernels.gaussian_raster.work_sharing import jump_of

AHEAD = 8
"""Gaussians between asking for sums and adding them up: some hundred nanoseconds each."""


class Gradients(NamedTuple):
    """Gradients of the arrays in `projection.Gaussians`; transforms per run in float64.

    Those that several views share hold sums; the last two belong to one view.
    """

    means: np.ndarray
    rotation_wxyz: np.ndarray
    scale_m: np.ndarray
    opacity: np.ndarray
    sh: np.ndarray
    features: np.ndarray
    absolute: np.ndarray
    camera_from_body: np.ndarray


@numba.njit(**EXACT)
def _put(array: np.ndarray, place: tuple[int, ...], value: float, adds: bool) -> None:
    """Write a number, or add it in float32 as if it had been written and added then."""
    array[place] = array[place] + np.float32(value) if adds else np.float32(value)


@numba.njit(**EXACT)
def _screen_gradient(sums: np.ndarray, record: np.ndarray) -> tuple[float, float]:
    """Gradient with respect to the projected centre, pixels."""
    across, shear, along = record[ACROSS], record[SHEAR], record[ALONG]
    x = 2.0 * across * sums[SUM_GU]
    return x, x * shear + 2.0 * along * sums[SUM_GY]


@numba.njit(**EXACT)
def _covariance_gradient(sums: np.ndarray, footprint: Footprint) -> Vector:
    """Gradient with respect to the blurred screen covariance's xx, xy and yy."""
    by_yy = 1.0 / footprint.yy
    slope = footprint.xy * by_yy
    by_remaining = 1.0 / (footprint.xx - slope * footprint.xy)
    # exponent = -u^2 / (2 remaining) - dy^2 / (2 yy), u = dx - slope dy
    to_remaining = 0.5 * sums[SUM_GUU] * by_remaining * by_remaining
    to_slope = by_remaining * sums[SUM_GUY] * by_yy
    to_yy = 0.5 * sums[SUM_GYY] * by_yy * by_yy
    return (
        to_remaining,
        to_slope - 2.0 * slope * to_remaining,
        slope * slope * to_remaining - slope * to_slope + to_yy,
    )


@numba.njit(**EXACT)
def _axes_gradient(
    footprint: Footprint, covariance_gradient: Vector, view: View
) -> tuple[Matrix, Vector]:
    """Gradients of the Gaussian's axes in the camera frame and of its centre there."""
    to_xx, to_xy, to_yy = covariance_gradient
    row_x, row_y, axes = footprint.row_x, footprint.row_y, footprint.axes_in_camera
    x, y, _ = footprint.point
    by_z = footprint.inverse_z
    to_row_x = v3.add(v3.scaled(row_x, 2.0 * to_xx), v3.scaled(row_y, to_xy))
    to_row_y = v3.add(v3.scaled(row_y, 2.0 * to_yy), v3.scaled(row_x, to_xy))
    to_axis_x = v3.scaled(to_row_x, view.fx * by_z)
    to_axis_y = v3.scaled(to_row_y, view.fy * by_z)
    to_axis_z = v3.add(
        v3.scaled(to_axis_x, -footprint.tangent_x), v3.scaled(to_axis_y, -footprint.tangent_y)
    )
    to_z = -(v3.dot(to_row_x, row_x) + v3.dot(to_row_y, row_y)) * by_z
    to_x, to_y = 0.0, 0.0
    if view.lowest_x <= x * by_z <= view.highest_x:
        to_x = -v3.dot(to_axis_x, axes[2]) * by_z
    if view.lowest_y <= y * by_z <= view.highest_y:
        to_y = -v3.dot(to_axis_y, axes[2]) * by_z
    to_point = (to_x, to_y, to_z - (to_x * x + to_y * y) * by_z)
    return (to_axis_x, to_axis_y, to_axis_z), to_point


@numba.njit(**EXACT)
def _centre_gradient(
    footprint: Footprint, to_screen: tuple[float, float], to_depth: float, view: View
) -> Vector:
    """Gradient of the centre in the camera frame through its pixel position and depth."""
    x, y, _ = footprint.point
    by_z = footprint.inverse_z
    to_x, to_y = to_screen[0] * view.fx * by_z, to_screen[1] * view.fy * by_z
    return (to_x, to_y, to_depth - (to_x * x + to_y * y) * by_z)


@numba.njit(**EXACT)
def _store_shape(
    gaussians: Gaussians,
    index: int,
    footprint: Footprint,
    to_axes: Matrix,
    gradients: Gradients,
    adds: bool,
) -> Matrix:
    """Store gradients of scale and rotation; return that of the transform's rotation."""
    to_from_axes = v3.product(v3.transposed(footprint.rotation), to_axes)
    turned = v3.rotation_matrix(footprint.unit_wxyz)
    scale = vector_of(gaussians.scale_m, index)
    by_axis, turned_axes = v3.transposed(to_from_axes), v3.transposed(turned)
    for k, gradient in enumerate(
        (
            v3.dot(by_axis[0], turned_axes[0]),
            v3.dot(by_axis[1], turned_axes[1]),
            v3.dot(by_axis[2], turned_axes[2]),
        )
    ):
        _put(gradients.scale_m, (index, k), gradient, adds)
    to_turned = v3.transposed(
        (
            v3.scaled(by_axis[0], scale[0]),
            v3.scaled(by_axis[1], scale[1]),
            v3.scaled(by_axis[2], scale[2]),
        )
    )
    unit = footprint.unit_wxyz
    to_unit = v3.rotation_gradient(unit, to_turned)
    along = to_unit[0] * unit[0] + to_unit[1] * unit[1] + to_unit[2] * unit[2]
    along += to_unit[3] * unit[3]
    by_length = 1.0 / footprint.wxyz_length
    for k in range(4):
        _put(gradients.rotation_wxyz, (index, k), (to_unit[k] - along * unit[k]) * by_length, adds)
    return v3.product(to_axes, v3.transposed(footprint.from_axes))


@numba.njit(**EXACT)
def _store_colour(  # noqa: PLR0913 - a compiled loop body
    gaussians: Gaussians,
    index: int,
    footprint: Footprint,
    record: np.ndarray,
    sums: np.ndarray,
    weights: np.ndarray,
    gradients: Gradients,
    adds: bool,
) -> Vector:
    """Store the gradient of the coefficients; return that of the view direction, metres."""
    mean = vector_of(gaussians.means, index)
    offset = view_direction(mean, footprint.rotation, footprint.translation)
    direction, length = v3.direction_of(offset)
    coefficients = gaussians.sh.shape[1]
    spherical_harmonics.basis(coefficients, direction, weights)
    to_colour = (
        sums[SUM_RED] if record[RED] > 0.0 else 0.0,
        sums[SUM_RED + 1] if record[RED + 1] > 0.0 else 0.0,
        sums[SUM_RED + 2] if record[RED + 2] > 0.0 else 0.0,
    )
    for k in range(coefficients):
        weight = weights[k]
        for channel in range(3):
            _put(gradients.sh, (index, k, channel), weight * to_colour[channel], adds)
        weights[k] = v3.dot(vector_of(gaussians.sh[index], k), to_colour)
    to_direction = spherical_harmonics.direction_gradient(coefficients, direction, weights)
    return v3.direction_of_gradient(direction, length, to_direction)


@numba.njit(**EXACT)
def _store_transform(to_rotation: Matrix, to_translation: Vector, out: np.ndarray) -> None:
    for row in range(3):
        for column in range(3):
            out[row, column] += to_rotation[row][column]
        out[row, 3] += to_translation[row]


@numba.njit(**EXACT)
def _unproject_one(  # noqa: PLR0913 - a compiled loop body
    gaussians: Gaussians,
    index: int,
    view: View,
    record: np.ndarray,
    sums: np.ndarray,
    weights: np.ndarray,
    gradients: Gradients,
    run: int,
    adds: bool,
) -> None:
    rotation, translation = transform_of(gaussians, index)
    mean = vector_of(gaussians.means, index)
    point = v3.add(v3.apply(rotation, mean), translation)
    footprint = footprint_of(gaussians, index, point, rotation, translation, view)
    to_screen = _screen_gradient(sums, record)
    absolute_x, absolute_y = record[ACROSS] * sums[SUM_ABS_X], sums[SUM_ABS_Y]
    absolute = math.sqrt(absolute_x * absolute_x + absolute_y * absolute_y)
    gradients.absolute[index] = 2.0 * absolute
    _put(gradients.opacity, (index,), sums[SUM_G] / gaussians.opacity[index], adds)
    to_covariance = _covariance_gradient(sums, footprint)
    to_axes, to_point = _axes_gradient(footprint, to_covariance, view)
    to_centre = _centre_gradient(footprint, to_screen, sums[SUM_DEPTH], view)
    to_point = v3.add(to_point, to_centre)
    to_rotation = _store_shape(gaussians, index, footprint, to_axes, gradients, adds)
    to_direction = _store_colour(
        gaussians, index, footprint, record, sums, weights, gradients, adds
    )
    to_mean = v3.add(v3.apply(v3.transposed(rotation), to_point), to_direction)
    for axis in range(3):
        _put(gradients.means, (index, axis), to_mean[axis], adds)
    # the direction is mean + rotation^T translation
    to_rotation = v3.added(to_rotation, v3.outer(to_point, mean))
    to_rotation = v3.added(to_rotation, v3.outer(translation, to_direction))
    to_translation = v3.add(to_point, v3.apply(rotation, to_direction))
    body = gaussians.body_index[index]
    _store_transform(to_rotation, to_translation, gradients.camera_from_body[run, body])


@numba.njit(**EXACT)
def _store_nothing(index: int, gradients: Gradients, adds: bool) -> None:
    """Gradients of a Gaussian that the view does not see."""
    gradients.absolute[index] = 0.0
    if not adds:
        gradients.means[index] = 0.0
        gradients.rotation_wxyz[index] = 0.0
        gradients.scale_m[index] = 0.0
        gradients.opacity[index] = 0.0
        gradients.sh[index] = 0.0
        gradients.features[index] = 0.0


@numba.njit(**EXACT)
def _unproject_run(  # noqa: PLR0913 - a compiled loop body
    gaussians: Gaussians,
    view: View,
    records: np.ndarray,
    lists: TileLists,
    slots: tuple[np.ndarray, np.ndarray],
    gradients: Gradients,
    run: int,
    adds: bool,
) -> None:
    weights, sums = np.empty(16), np.empty(SUMS)
    feature_sums = np.empty(slots[1].shape[1])
    count = len(records)
    first, end = run * count // CHUNKS, (run + 1) * count // CHUNKS
    for index in range(first, end):
        prefetch_entries(lists, min(index + AHEAD, end - 1), records, slots[0])
        if records[index, IS_VISIBLE] > 0.0:
            add_entries(lists, index, slots[0], slots[1], sums, feature_sums)
            for k in range(len(feature_sums)):
                _put(gradients.features, (index, k), feature_sums[k], adds)
            _unproject_one(
                gaussians, index, view, records[index], sums, weights, gradients, run, adds
            )
        else:
            _store_nothing(index, gradients, adds)


@compiled_entry
def unproject(
    gaussians: Gaussians,
    view: View,
    records: np.ndarray,
    lists: TileLists,
    slots: tuple[np.ndarray, np.ndarray],
    gradients: Gradients,
    adds: bool,
) -> None:
    """Write, or add to what other views gave, the gradients of everything `project` read.

    `records` are those of `projection.project`, `lists` of `binning.list_tiles`, `slots` of
    `blending_gradients.entry_sums`. `gradients` is room, or the sums so far if `adds`; the
    transforms' must be zeros. Every row is written.
    """
    jump = jump_of(CHUNKS)
    for place in numba.prange(CHUNKS):
        run = place * jump % CHUNKS
        _unproject_run(gaussians, view, records, lists, slots, gradients, run, adds)
