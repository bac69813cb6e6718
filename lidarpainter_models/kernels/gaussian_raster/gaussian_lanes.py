"""Eight Gaussians at once: their numbers as float64 lanes, picked out of rows and put back.

Rows are the places of the eight in a run of Gaussians. Where a run ends before the eighth, its last
row stands for the rest: they read, compute and write the same again.
"""

# ruff: noqa: ANN001, ANN201, ANN202, ARG001 - numba calls these with its own types and builders

from typing import NamedTuple

import numba
import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils

from lidarpainter_models.kernels.gaussian_raster.compilation import EXACT
from lidarpainter_models.kernels.gaussian_raster.lane_types import (
    DOUBLES,
    index,
    intrinsic,
    load,
    shuffled,
    spread_to,
    spreading,
    store,
)
from lidarpainter_models.kernels.gaussian_raster.small_vectors import Matrix, Vector

EIGHT = DOUBLES.count


class Rows(NamedTuple):
    """Eight Gaussians of a run."""

    places: np.ndarray
    """Where each stands among all, int64."""
    bodies: np.ndarray
    """Which body each belongs to, int64."""


@numba.njit(**EXACT)
def lanes_at(array: np.ndarray, number: int) -> float:
    """The lanes of that number in a flat float64 array of eight each."""
    return load(array, EIGHT * number)


@numba.njit(**EXACT)
def set_lanes(array: np.ndarray, number: int, value: float) -> None:
    """Put lanes, or a number in all of them, where `lanes_at` finds them."""
    store(array, EIGHT * number, value)


@intrinsic
def lane_numbers(typingctx):
    """0.0, 1.0, ... 7.0."""

    def generate(context, builder, signature, arguments):
        return ir.Constant(DOUBLES.vector, [float(lane) for lane in range(EIGHT)])

    return DOUBLES(), generate


in_all = spreading(DOUBLES)
"""A number in all lanes."""


def _pointers(context, builder, kinds, where):
    """Where numbers of eight rows stand: an array, its rows, numbers in each, and the column."""
    array, rows, stride, column = where
    data = context.make_array(kinds[0])(context, builder, array).data
    places = context.make_array(kinds[1])(context, builder, rows).data
    for lane in range(EIGHT):
        row = builder.load(cgutils.gep_inbounds(builder, places, lane))
        place = builder.add(builder.mul(row, stride), column)
        yield cgutils.gep_inbounds(builder, data, place)


def _gathered(builder, numbers, element):
    value = ir.Constant(ir.VectorType(element, EIGHT), ir.Undefined)
    for lane, number in enumerate(numbers):
        value = builder.insert_element(value, number, index(lane))
    return value


@intrinsic
def pick(typingctx, array, rows, stride, column):
    """A column of eight rows of a contiguous array of floats, as float64."""
    signature = DOUBLES(array, rows, types.int64, types.int64)

    def generate(context, builder, signature, arguments):
        pointers = _pointers(context, builder, (array, rows), arguments)
        element = context.get_value_type(array.dtype)
        value = _gathered(builder, map(builder.load, pointers), element)
        is_wide = array.dtype == types.float64
        return value if is_wide else builder.fpext(value, DOUBLES.vector)

    return signature, generate


@intrinsic
def put(typingctx, array, rows, stride, column, value):
    """Write a column of eight rows of a contiguous float32 array."""
    signature = types.void(array, rows, types.int64, types.int64, value)
    singles = ir.VectorType(ir.FloatType(), EIGHT)

    def generate(context, builder, signature, arguments):
        pointers = _pointers(context, builder, (array, rows), arguments[:4])
        wide = spread_to(DOUBLES, context, builder, arguments[4], value)
        new = builder.fptrunc(wide, singles)
        for lane, pointer in enumerate(pointers):
            builder.store(builder.extract_element(new, index(lane)), pointer)

    return signature, generate


@intrinsic
def total(typingctx, value):
    """Sum of all lanes."""

    def generate(context, builder, signature, arguments):
        value = arguments[0]
        for half in (4, 2, 1):
            low = shuffled(builder, value, value, range(half))
            value = builder.fadd(low, shuffled(builder, value, value, range(half, 2 * half)))
        return builder.extract_element(value, index(0))

    return types.float64(value), generate


@numba.njit(**EXACT)
def rows_of(body_index: np.ndarray, start: int, end: int, rows: Rows) -> bool:
    """Go to eight Gaussians of a run that ends before `end`; whether they are of one body."""
    for lane in range(EIGHT):
        rows.places[lane] = min(start + lane, end - 1)
        rows.bodies[lane] = body_index[rows.places[lane]]
    return bool((rows.bodies == rows.bodies[0]).all())


@numba.njit(**EXACT)
def _of_body(transforms: np.ndarray, rows: Rows, of_one_body: bool, number: int) -> float:
    if of_one_body:
        return in_all(transforms[rows.bodies[0], number // 4, number % 4])
    return pick(transforms, rows.bodies, 16, number)


@numba.njit(**EXACT)
def _three(transforms: np.ndarray, rows: Rows, of_one_body: bool, first: int, step: int) -> Vector:
    return (
        _of_body(transforms, rows, of_one_body, first),
        _of_body(transforms, rows, of_one_body, first + step),
        _of_body(transforms, rows, of_one_body, first + 2 * step),
    )


@numba.njit(**EXACT)
def transforms_of(transforms: np.ndarray, rows: Rows, of_one_body: bool) -> tuple[Matrix, Vector]:
    """Rotation rows and translations of the bodies of eight Gaussians; `transforms` is float64."""
    rotation = (
        _three(transforms, rows, of_one_body, 0, 1),
        _three(transforms, rows, of_one_body, 4, 1),
        _three(transforms, rows, of_one_body, 8, 1),
    )
    return rotation, _three(transforms, rows, of_one_body, 3, 4)


@numba.njit(**EXACT)
def vector_of(array: np.ndarray, rows: Rows) -> Vector:
    """Rows of three."""
    places = rows.places
    return (pick(array, places, 3, 0), pick(array, places, 3, 1), pick(array, places, 3, 2))
