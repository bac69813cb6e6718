"""Carry screen gradients back through the projection, one Gaussian a lane, in float64.

The same mathematics as the numba `projection_gradients`: the projection is computed again rather
than kept. Only lanes that were drawn read and write, so what is not finite in others stays there.
"""

import triton
import triton.language as tl

from lidarpainter_models.kernels.gaussian_raster.triton_kernels import blending_gradients as slots
from lidarpainter_models.kernels.gaussian_raster.triton_kernels import records as screen
from lidarpainter_models.kernels.gaussian_raster.triton_kernels import vectors as v3
from lidarpainter_models.kernels.gaussian_raster.triton_kernels.harmonics import basis, slopes
from lidarpainter_models.kernels.gaussian_raster.triton_kernels.projection import (
    BLUR_PX2,
    body_axes,
    load_lens,
    load_quaternion,
    screen_rows,
    view_direction,
)
from lidarpainter_models.kernels.gaussian_raster.triton_kernels.records import record_of


@triton.jit
def _covariance_gradient(slot, xx, xy, yy, mask):
    """Gradient with respect to the blurred screen covariance's xx, xy and yy."""
    by_yy = 1.0 / yy
    slope = xy * by_yy
    by_remaining = 1.0 / (xx - slope * xy)
    # exponent = -u^2 / (2 remaining) - dy^2 / (2 yy), u = dx - slope dy
    guu = tl.load(slot + slots.SUM_GUU, mask=mask, other=0.0)
    to_remaining = 0.5 * guu * by_remaining * by_remaining
    to_slope = by_remaining * tl.load(slot + slots.SUM_GUY, mask=mask, other=0.0) * by_yy
    to_yy = 0.5 * tl.load(slot + slots.SUM_GYY, mask=mask, other=0.0) * by_yy * by_yy
    return (
        to_remaining,
        to_slope - 2.0 * slope * to_remaining,
        slope * slope * to_remaining - slope * to_slope + to_yy,
    )


@triton.jit
def _centre_gradient(slot, record, point, lens, mask):
    """Gradient of centres in the camera frame through their pixel position and depth."""
    across = tl.load(record + screen.ACROSS, mask=mask, other=0.0).to(tl.float64)
    shear = tl.load(record + screen.SHEAR, mask=mask, other=0.0).to(tl.float64)
    along = tl.load(record + screen.ALONG, mask=mask, other=0.0).to(tl.float64)
    to_u = 2.0 * across * tl.load(slot + slots.SUM_GU, mask=mask, other=0.0)
    to_v = to_u * shear + 2.0 * along * tl.load(slot + slots.SUM_GY, mask=mask, other=0.0)
    to_x, to_y = to_u * lens[0] / point[2], to_v * lens[1] / point[2]
    to_depth = tl.load(slot + slots.SUM_DEPTH, mask=mask, other=0.0)
    return (to_x, to_y, to_depth - (to_x * point[0] + to_y * point[1]) / point[2])


@triton.jit
def _axes_gradient(slot, axes, point, lens, mask):
    """Gradients of the Gaussians' axes in the camera frame and of their centres there."""
    row_x, row_y, tangent_x, tangent_y = screen_rows(axes, point, lens)
    xx, yy = v3.dot(row_x, row_x) + BLUR_PX2, v3.dot(row_y, row_y) + BLUR_PX2
    to_xx, to_xy, to_yy = _covariance_gradient(slot, xx, v3.dot(row_x, row_y), yy, mask)
    by_z = 1.0 / point[2]
    to_row_x = v3.add(v3.scaled(row_x, 2.0 * to_xx), v3.scaled(row_y, to_xy))
    to_row_y = v3.add(v3.scaled(row_y, 2.0 * to_yy), v3.scaled(row_x, to_xy))
    to_axis_x, to_axis_y = v3.scaled(to_row_x, lens[0] * by_z), v3.scaled(to_row_y, lens[1] * by_z)
    to_axis_z = v3.add(v3.scaled(to_axis_x, -tangent_x), v3.scaled(to_axis_y, -tangent_y))
    to_z = -(v3.dot(to_row_x, row_x) + v3.dot(to_row_y, row_y)) * by_z
    # a tangent that was held at the margin does not move
    to_x = tl.where(tangent_x == point[0] * by_z, -v3.dot(to_axis_x, axes[2]) * by_z, 0.0)
    to_y = tl.where(tangent_y == point[1] * by_z, -v3.dot(to_axis_y, axes[2]) * by_z, 0.0)
    to_point = (to_x, to_y, to_z - (to_x * point[0] + to_y * point[1]) * by_z)
    return (to_axis_x, to_axis_y, to_axis_z), to_point


@triton.jit
def _store_shape(to_from_axes, quaternion, length, scale, to_scale, to_rotation_wxyz, index, mask):
    """Add gradients of scale and rotation from those of the axes in the frame of the body."""
    w, x, y, z = quaternion
    by_axis = v3.transposed(to_from_axes)
    turned_axes = v3.transposed(v3.rotation_matrix(w, x, y, z))
    of_scale = (
        v3.dot(by_axis[0], turned_axes[0]),
        v3.dot(by_axis[1], turned_axes[1]),
        v3.dot(by_axis[2], turned_axes[2]),
    )
    v3.add_vector(to_scale, index, mask, of_scale)
    to_turned = (
        v3.scaled(by_axis[0], scale[0]),
        v3.scaled(by_axis[1], scale[1]),
        v3.scaled(by_axis[2], scale[2]),
    )
    to_unit = v3.rotation_gradient(w, x, y, z, v3.transposed(to_turned))
    along = to_unit[0] * w + to_unit[1] * x + to_unit[2] * y + to_unit[3] * z
    start = to_rotation_wxyz + 4 * index.to(tl.int64)
    for k in tl.static_range(4):
        before = tl.load(start + k, mask=mask, other=0.0)
        gradient = (to_unit[k] - along * quaternion[k]) / length
        tl.store(start + k, before + gradient.to(tl.float32), mask=mask)


@triton.jit
def _store_colour(
    slot, record, direction, length, sh, to_sh, index, mask, COEFFICIENTS: tl.constexpr
):
    """Add the gradient of the coefficients; return that of the view direction, metres."""
    x, y, z = direction
    weights = basis(x, y, z)
    along_x, along_y, along_z = slopes(x, y, z)
    to_x, to_y, to_z = 0.0 * x, 0.0 * x, 0.0 * x
    start = index.to(tl.int64) * (3 * COEFFICIENTS)
    for channel in tl.static_range(3):
        # a colour held at zero does not move
        lit = mask & (tl.load(record + screen.RED + channel, mask=mask, other=0.0) > 0.0)
        to_colour = tl.load(slot + slots.SUM_RED + channel, mask=lit, other=0.0)
        for k in tl.static_range(COEFFICIENTS):
            place = start + 3 * k + channel
            before = tl.load(to_sh + place, mask=mask, other=0.0)
            tl.store(to_sh + place, before + (weights[k] * to_colour).to(tl.float32), mask=mask)
            to_weight = tl.load(sh + place, mask=mask, other=0.0) * to_colour
            to_x += along_x[k] * to_weight
            to_y += along_y[k] * to_weight
            to_z += along_z[k] * to_weight
    across = v3.add((to_x, to_y, to_z), v3.scaled(direction, -(to_x * x + to_y * y + to_z * z)))
    return v3.scaled(across, 1.0 / length)


@triton.jit
def _add_pose(to_camera_from_body, body, mask, rows, translation):
    """Add up over the lanes of each body among them; one addition for each body and number."""
    lowest = tl.min(tl.where(mask, body, 2147483647), axis=0)
    highest = tl.max(tl.where(mask, body, -1), axis=0)
    for own in range(lowest, highest + 1):
        chosen = mask & (body == own)
        start = to_camera_from_body + own * 16
        for row in tl.static_range(3):
            for column in tl.static_range(3):
                value = tl.sum(tl.where(chosen, rows[row][column], 0.0), axis=0)
                tl.atomic_add(start + 4 * row + column, value)
            value = tl.sum(tl.where(chosen, translation[row], 0.0), axis=0)
            tl.atomic_add(start + 4 * row + 3, value)


@triton.jit(do_not_specialize=["count"])
def unproject(
    means,
    rotation_wxyz,
    scale_m,
    opacity,
    sh,
    body_index,
    camera_from_body,
    lens,
    records,
    sums,
    to_means,
    to_rotation_wxyz,
    to_scale,
    to_opacity,
    to_sh,
    to_camera_from_body,
    screen_gradient,
    count,
    COEFFICIENTS: tl.constexpr,
    BLOCK: tl.constexpr,
):
    """Add the gradients of everything `project` read; write the length of the screen gradient.

    Those of transforms are summed over lanes and then by float64 atomics, whose order no float32
    of the result can see.
    """
    index = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    record = record_of(records, index)
    slot = sums + index.to(tl.int64) * slots.SLOT
    exists = index < count
    mask = exists & (tl.load(record + screen.IS_VISIBLE, mask=exists, other=0.0) > 0.0)
    optics = load_lens(lens)
    body = tl.load(body_index + index, mask=mask, other=0)
    rotation, translation = v3.load_pose(camera_from_body, body, mask)
    mean = v3.load_vector(means, index, mask, 0.0)
    point = v3.add(v3.apply(rotation, mean), translation)
    point = (point[0], point[1], tl.where(mask, point[2], 1.0))
    scale = v3.load_vector(scale_m, index, mask, 1.0)
    quaternion, wxyz_length = load_quaternion(rotation_wxyz, index, mask)
    from_axes = body_axes(quaternion, scale)
    to_axes, to_point = _axes_gradient(slot, v3.product(rotation, from_axes), point, optics, mask)
    to_point = v3.add(to_point, _centre_gradient(slot, record, point, optics, mask))
    back = v3.transposed(rotation)
    _store_shape(
        v3.product(back, to_axes),
        quaternion,
        wxyz_length,
        scale,
        to_scale,
        to_rotation_wxyz,
        index,
        mask,
    )
    direction, distance = view_direction(mean, rotation, translation)
    to_direction = _store_colour(
        slot, record, direction, distance, sh, to_sh, index, mask, COEFFICIENTS
    )
    v3.add_vector(to_means, index, mask, v3.add(v3.apply(back, to_point), to_direction))
    before = tl.load(to_opacity + index, mask=mask, other=0.0)
    of_opacity = tl.load(slot + slots.SUM_G, mask=mask, other=0.0)
    of_opacity = of_opacity / tl.load(opacity + index, mask=mask, other=1.0)
    tl.store(to_opacity + index, before + of_opacity.to(tl.float32), mask=mask)
    absolute_x = tl.load(slot + slots.SUM_ABS_X, mask=mask, other=0.0)
    absolute_x = absolute_x * tl.load(record + screen.ACROSS, mask=mask, other=0.0)
    absolute_y = tl.load(slot + slots.SUM_ABS_Y, mask=mask, other=0.0)
    absolute = 2.0 * tl.sqrt(absolute_x * absolute_x + absolute_y * absolute_y)
    tl.store(screen_gradient + index, absolute.to(tl.float32), mask=mask)
    # axes are rotation times those in the body; the direction is mean + rotation^T translation
    by_rows = v3.product(to_axes, v3.transposed(from_axes))
    rows = (
        _turned(by_rows[0], mean, to_point[0], to_direction, translation[0]),
        _turned(by_rows[1], mean, to_point[1], to_direction, translation[1]),
        _turned(by_rows[2], mean, to_point[2], to_direction, translation[2]),
    )
    to_translation = v3.add(to_point, v3.apply(rotation, to_direction))
    _add_pose(to_camera_from_body, body, mask, rows, to_translation)


@triton.jit
def _turned(row, mean, to_point, to_direction, translation):
    """Gradient of a row of a rotation through axes, centre and view direction."""
    return v3.add(row, v3.add(v3.scaled(mean, to_point), v3.scaled(to_direction, translation)))
