"""Gradients of footprints with respect to what they are made of: compiled code on eight Gaussians.

`projection` says what a footprint is; all numbers are float64 lanes.
"""

import numba

from lidarpainter_models.kernels.gaussian_raster import small_vectors as v3
from lidarpainter_models.kernels.gaussian_raster.compilation import EXACT
from lidarpainter_models.kernels.gaussian_raster.lane_types import choose
from lidarpainter_models.kernels.gaussian_raster.projection import Footprint, View
from lidarpainter_models.kernels.gaussian_raster.small_vectors import Matrix, Quaternion, Vector


@numba.njit(**EXACT)
def covariance_gradient(
    footprint: Footprint, sum_uu: float, sum_uy: float, sum_yy: float
) -> Vector:
    """Gradient with respect to the blurred screen covariance's xx, xy and yy.

    The sums are over pixels, of the exponent's gradient times the offsets u and dy.
    """
    by_yy = 1.0 / footprint.yy
    slope = footprint.xy * by_yy
    by_remaining = 1.0 / (footprint.xx - slope * footprint.xy)
    # exponent = -u^2 / (2 remaining) - dy^2 / (2 yy), u = dx - slope dy
    to_remaining = 0.5 * sum_uu * by_remaining * by_remaining
    to_slope = by_remaining * sum_uy * by_yy
    to_yy = 0.5 * sum_yy * by_yy * by_yy
    return (
        to_remaining,
        to_slope - 2.0 * slope * to_remaining,
        slope * slope * to_remaining - slope * to_slope + to_yy,
    )


@numba.njit(**EXACT)
def axes_gradient(
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
    is_free_x = (x * by_z >= view.lowest_x) & (x * by_z <= view.highest_x)
    is_free_y = (y * by_z >= view.lowest_y) & (y * by_z <= view.highest_y)
    to_x = choose(is_free_x, -v3.dot(to_axis_x, axes[2]) * by_z, 0.0)
    to_y = choose(is_free_y, -v3.dot(to_axis_y, axes[2]) * by_z, 0.0)
    to_point = (to_x, to_y, to_z - (to_x * x + to_y * y) * by_z)
    return (to_axis_x, to_axis_y, to_axis_z), to_point


@numba.njit(**EXACT)
def centre_gradient(
    footprint: Footprint, to_screen: tuple[float, float], to_depth: float, view: View
) -> Vector:
    """Gradient of the centre in the camera frame through its pixel position and depth."""
    x, y, _ = footprint.point
    by_z = footprint.inverse_z
    to_x, to_y = to_screen[0] * view.fx * by_z, to_screen[1] * view.fy * by_z
    return (to_x, to_y, to_depth - (to_x * x + to_y * y) * by_z)


@numba.njit(**EXACT)
def shape_gradient(
    footprint: Footprint, scale_m: Vector, to_axes: Matrix
) -> tuple[Vector, Quaternion, Matrix]:
    """Gradients of scale, of the rotation before it is made unit, and of the body's rotation."""
    to_from_axes = v3.product(v3.transposed(footprint.rotation), to_axes)
    turned_axes = v3.transposed(v3.rotation_matrix(footprint.unit_wxyz))
    by_axis = v3.transposed(to_from_axes)
    to_scale = (
        v3.dot(by_axis[0], turned_axes[0]),
        v3.dot(by_axis[1], turned_axes[1]),
        v3.dot(by_axis[2], turned_axes[2]),
    )
    to_turned = v3.transposed(
        (
            v3.scaled(by_axis[0], scale_m[0]),
            v3.scaled(by_axis[1], scale_m[1]),
            v3.scaled(by_axis[2], scale_m[2]),
        )
    )
    unit = footprint.unit_wxyz
    to_unit = v3.rotation_gradient(unit, to_turned)
    along = to_unit[0] * unit[0] + to_unit[1] * unit[1] + to_unit[2] * unit[2]
    along += to_unit[3] * unit[3]
    by_length = 1.0 / footprint.wxyz_length
    to_wxyz = (
        (to_unit[0] - along * unit[0]) * by_length,
        (to_unit[1] - along * unit[1]) * by_length,
        (to_unit[2] - along * unit[2]) * by_length,
        (to_unit[3] - along * unit[3]) * by_length,
    )
    return to_scale, to_wxyz, v3.product(to_axes, v3.transposed(footprint.from_axes))
