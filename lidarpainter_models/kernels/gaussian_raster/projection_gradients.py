"""Carry screen gradients back through the projection: compiled code, eight Gaussians at a time.

Each Gaussian first adds up the sums of its entries, tiles in reading order. The projection is
computed again rather than kept. Everything is float64; the gradient of `camera_from_body` is summed
over fixed eights, then over fixed runs of Gaussians and over these, in order, so it does not depend
on the number of threads.
"""

import math
from typing import NamedTuple

import numba
import numpy as np

from lidarpainter_models.kernels.gaussian_raster import blending_gradients as sums
from lidarpainter_models.kernels.gaussian_raster import projection as screen
from lidarpainter_models.kernels.gaussian_raster import small_vectors as v3
from lidarpainter_models.kernels.gaussian_raster import spherical_harmonics
from lidarpainter_models.kernels.gaussian_raster.binning import TileLists
from lidarpainter_models.kernels.gaussian_raster.blending_gradients import (
    add_entries,
    prefetch_entries,
)
from lidarpainter_models.kernels.gaussian_raster.compilation import EXACT, compiled_entry, jump_of
from lidarpainter_models.kernels.gaussian_raster.footprint_gradients import (
    axes_gradient,
    centre_gradient,
    covariance_gradient,
    shape_gradient,
)
from lidarpainter_models.kernels.gaussian_raster.gaussian_lanes import (
    EIGHT,
    Rows,
    in_all,
    lane_numbers,
    lanes_at,
    pick,
    put,
    rows_of,
    set_lanes,
    total,
    transforms_of,
    vector_of,
)
from lidarpainter_models.kernels.gaussian_raster.lane_types import choose
from lidarpainter_models.kernels.gaussian_raster.projection import (
    Footprint,
    Gaussians,
    View,
    footprint_of,
    view_direction,
)
from lidarpainter_models.kernels.gaussian_raster.small_vectors import Matrix, Vector


class Gradients(NamedTuple):
    """Gradients of the float arrays in `projection.Gaussians`; transforms per run in float64."""

    means: np.ndarray
    rotation_wxyz: np.ndarray
    scale_m: np.ndarray
    opacity: np.ndarray
    sh: np.ndarray
    features: np.ndarray
    camera_from_body: np.ndarray
    absolute: np.ndarray


class _Eight(NamedTuple):
    """Eight Gaussians of a run, and room to work on them."""

    rows: Rows
    lanes: np.ndarray
    """0 to 7: their rows in `sums`."""
    sums: np.ndarray
    """Each Gaussian's sums over its entries, (8, sums.SUMS)."""
    features: np.ndarray
    """The same of one Gaussian's features."""
    weights: np.ndarray
    """Lanes for each harmonic, or for each number of a transform."""


@numba.njit(**EXACT)
def _sum_of(eight: _Eight, column: int) -> float:
    return pick(eight.sums, eight.lanes, sums.SUMS, column)


@numba.njit(**EXACT)
def _recorded(eight: _Eight, records: np.ndarray, column: int) -> float:
    return pick(records, eight.rows.places, screen.RECORD_FLOATS, column)


@numba.njit(**EXACT)
def _screen_gradient(eight: _Eight, records: np.ndarray) -> tuple[float, float]:
    """Gradient with respect to the projected centre, pixels."""
    x = 2.0 * _recorded(eight, records, screen.ACROSS) * _sum_of(eight, sums.SUM_GU)
    along = _recorded(eight, records, screen.ALONG)
    shear = _recorded(eight, records, screen.SHEAR)
    return x, x * shear + 2.0 * along * _sum_of(eight, sums.SUM_GY)


@numba.njit(**EXACT)
def _colour_gradient(eight: _Eight, visible: bool, records: np.ndarray, channel: int) -> float:
    """Gradient of a channel's colour, none where it was cut off at black."""
    colour = _recorded(eight, records, screen.RED + channel)
    return choose(visible & (colour > 0.0), _sum_of(eight, sums.SUM_RED + channel), 0.0)


@numba.njit(**EXACT)
def _store_colour(
    gaussians: Gaussians,
    eight: _Eight,
    visible: bool,
    footprint: Footprint,
    records: np.ndarray,
    gradients: Gradients,
) -> Vector:
    """Store the gradient of the coefficients; return that of the view direction, metres."""
    places, weights = eight.rows.places, eight.weights
    mean = vector_of(gaussians.means, eight.rows)
    offset = view_direction(mean, footprint.rotation, footprint.translation)
    direction, length = v3.direction_of(offset)
    coefficients = gaussians.sh.shape[1]
    spherical_harmonics.basis(coefficients, direction, weights)
    to_colour = (
        _colour_gradient(eight, visible, records, 0),
        _colour_gradient(eight, visible, records, 1),
        _colour_gradient(eight, visible, records, 2),
    )
    for k in range(coefficients):
        weight, to_weight = lanes_at(weights, k), in_all(0.0)
        for channel in range(3):
            place = 3 * k + channel
            found = choose(visible, weight * to_colour[channel], 0.0)
            put(gradients.sh, places, 3 * coefficients, place, found)
            harmonic = pick(gaussians.sh, places, 3 * coefficients, place)
            to_weight += harmonic * to_colour[channel]
        set_lanes(weights, k, to_weight)
    to_direction = spherical_harmonics.direction_gradient(coefficients, direction, weights)
    return v3.direction_of_gradient(direction, length, to_direction)


@numba.njit(**EXACT)
def _add_transform(
    to_rotation: Matrix,
    to_translation: Vector,
    eight: _Eight,
    counted: bool,
    of_one_body: bool,
    out: np.ndarray,
) -> None:
    """Add to the gradients of the bodies' transforms, (bodies, 3, 4), what each Gaussian gives."""
    for row in range(3):
        for column in range(3):
            found = choose(counted, to_rotation[row][column], 0.0)
            set_lanes(eight.weights, 4 * row + column, found)
        set_lanes(eight.weights, 4 * row + 3, choose(counted, to_translation[row], 0.0))
    bodies = eight.rows.bodies
    for number in range(12):
        row, column = number // 4, number % 4
        if of_one_body:
            out[bodies[0], row, column] += total(lanes_at(eight.weights, number))
        else:
            for lane in range(EIGHT):
                out[bodies[lane], row, column] += eight.weights[EIGHT * number + lane]


@numba.njit(**EXACT)
def _unproject_eight(  # noqa: PLR0913 - a compiled loop body
    gaussians: Gaussians,
    eight: _Eight,
    count: int,
    of_one_body: bool,
    view: View,
    records: np.ndarray,
    gradients: Gradients,
    transforms: np.ndarray,
) -> None:
    rows, places = eight.rows, eight.rows.places
    visible = _recorded(eight, records, screen.IS_VISIBLE) > 0.0
    rotation, translation = transforms_of(gaussians.camera_from_body, rows, of_one_body)
    mean = vector_of(gaussians.means, rows)
    point = v3.add(v3.apply(rotation, mean), translation)
    footprint = footprint_of(gaussians, rows, point, rotation, translation, view)
    to_screen = _screen_gradient(eight, records)
    across = _recorded(eight, records, screen.ACROSS)
    absolute_x, absolute_y = across * _sum_of(eight, sums.SUM_ABS_X), _sum_of(eight, sums.SUM_ABS_Y)
    absolute = 2.0 * math.sqrt(absolute_x * absolute_x + absolute_y * absolute_y)
    put(gradients.absolute, places, 1, 0, choose(visible, absolute, 0.0))
    to_opacity = _sum_of(eight, sums.SUM_G) / pick(gaussians.opacity, places, 1, 0)
    put(gradients.opacity, places, 1, 0, choose(visible, to_opacity, 0.0))
    sum_uu, sum_uy = _sum_of(eight, sums.SUM_GUU), _sum_of(eight, sums.SUM_GUY)
    to_covariance = covariance_gradient(footprint, sum_uu, sum_uy, _sum_of(eight, sums.SUM_GYY))
    to_axes, to_point = axes_gradient(footprint, to_covariance, view)
    to_centre = centre_gradient(footprint, to_screen, _sum_of(eight, sums.SUM_DEPTH), view)
    to_point = v3.add(to_point, to_centre)
    scale = vector_of(gaussians.scale_m, rows)
    to_scale, to_wxyz, to_rotation = shape_gradient(footprint, scale, to_axes)
    for axis in range(3):
        put(gradients.scale_m, places, 3, axis, choose(visible, to_scale[axis], 0.0))
    for k in range(4):
        put(gradients.rotation_wxyz, places, 4, k, choose(visible, to_wxyz[k], 0.0))
    to_direction = _store_colour(gaussians, eight, visible, footprint, records, gradients)
    to_mean = v3.add(v3.apply(v3.transposed(rotation), to_point), to_direction)
    for axis in range(3):
        put(gradients.means, places, 3, axis, choose(visible, to_mean[axis], 0.0))
    # the direction is mean + rotation^T translation
    to_rotation = v3.added(to_rotation, v3.outer(to_point, mean))
    to_rotation = v3.added(to_rotation, v3.outer(translation, to_direction))
    to_translation = v3.add(to_point, v3.apply(rotation, to_direction))
    counted = visible & (lane_numbers() < count)
    _add_transform(to_rotation, to_translation, eight, counted, of_one_body, transforms)


@numba.njit(**EXACT)
def _sum_entries(
    lists: TileLists,
    slots: tuple[np.ndarray, np.ndarray],
    eight: _Eight,
    count: int,
    records: np.ndarray,
    gradients: Gradients,
) -> bool:
    """Sum up the entries of eight Gaussians, store their features'; whether any is visible."""
    is_any = False
    for lane in range(EIGHT):
        place = eight.rows.places[lane]
        if records[place, screen.IS_VISIBLE] > 0.0:
            is_any = True
            add_entries(lists, place, slots[0], slots[1], eight.sums[lane], eight.features)
        else:
            eight.features[:] = 0.0
        if lane < count:
            for k in range(len(eight.features)):
                gradients.features[place, k] = eight.features[k]
    return is_any


@numba.njit(**EXACT)
def _store_nothing(rows: Rows, gradients: Gradients) -> None:
    """Gradients of Gaussians that the view does not see."""
    for place in rows.places:
        gradients.absolute[place] = 0.0
        gradients.means[place] = 0.0
        gradients.rotation_wxyz[place] = 0.0
        gradients.scale_m[place] = 0.0
        gradients.opacity[place] = 0.0
        gradients.sh[place] = 0.0


@numba.njit(**EXACT)
def _unproject_run(
    gaussians: Gaussians,
    view: View,
    records: np.ndarray,
    lists: TileLists,
    slots: tuple[np.ndarray, np.ndarray],
    gradients: Gradients,
    run: int,
) -> None:
    eight = _Eight(
        Rows(np.empty(EIGHT, np.int64), np.empty(EIGHT, np.int64)),
        np.arange(EIGHT),
        np.zeros((EIGHT, sums.SUMS)),
        np.empty(slots[1].shape[1]),
        np.empty(16 * EIGHT),
    )
    count = len(records)
    first, end = run * count // screen.CHUNKS, (run + 1) * count // screen.CHUNKS
    for start in range(first, end, EIGHT):
        of_one_body = rows_of(gaussians.body_index, start, end, eight.rows)
        for ahead in range(start + EIGHT, min(start + 2 * EIGHT, end)):
            prefetch_entries(lists, ahead, records, slots[0])
        here = min(EIGHT, end - start)
        if _sum_entries(lists, slots, eight, here, records, gradients):
            _unproject_eight(
                gaussians,
                eight,
                here,
                of_one_body,
                view,
                records,
                gradients,
                gradients.camera_from_body[run],
            )
        else:
            _store_nothing(eight.rows, gradients)


@compiled_entry
def unproject(
    gaussians: Gaussians,
    view: View,
    records: np.ndarray,
    lists: TileLists,
    slots: tuple[np.ndarray, np.ndarray],
    gradients: Gradients,
) -> None:
    """Write the gradients of everything `project` read.

    `records` are those of `projection.project`, `lists` of `binning.list_tiles`, `slots` of
    `blending_gradients.entry_sums`. `gradients` is room; the transforms' must be zeros. Every
    row is written.
    """
    jump = jump_of(screen.CHUNKS)
    for place in numba.prange(screen.CHUNKS):
        run = place * jump % screen.CHUNKS
        _unproject_run(gaussians, view, records, lists, slots, gradients, run)
