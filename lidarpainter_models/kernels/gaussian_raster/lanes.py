"""Sixteen float32 numbers at once: a row of a screen tile.

The loops over pixels are written in these (`lane_types`) and not left to the compiler's loop
vectoriser, which pays for every short loop with a scalar remainder and keeps no sums in registers
between rows.
"""

# ruff: noqa: ANN001, ANN201, ANN202, ARG001 - numba calls these with its own types and builders

import numba
import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils

from lidarpainter_models.kernels.gaussian_raster.compilation import EXACT
from lidarpainter_models.kernels.gaussian_raster.lane_types import (
    FLOATS,
    address,
    extreme,
    index,
    intrinsic,
    shuffled,
    spreading,
)

LANES = FLOATS.count
EIGHTH = np.float32(0.125)
# minimax in relative error over the exponents that survive the alpha cut, divided by eight
C0 = np.float32(0.99999994)
C1 = np.float32(0.99999183)
C2 = np.float32(0.49987432)
C3 = np.float32(0.16593865)
C4 = np.float32(0.03971106)
C5 = np.float32(0.0058094156)


@intrinsic
def lane_centres(typingctx):
    """0.5, 1.5, ... 15.5: pixel centres of a tile row."""

    def generate(context, builder, signature, arguments):
        single = ir.FloatType()
        return ir.Constant(FLOATS.vector, [ir.Constant(single, k + 0.5) for k in range(LANES)])

    return FLOATS(), generate


spread = spreading(FLOATS)
"""A number in all lanes."""


def _quarter(builder, value):
    """Four partial sums of sixteen lanes."""
    for half in (LANES // 2, LANES // 4):
        low = shuffled(builder, value, value, range(half))
        high = shuffled(builder, value, value, range(half, 2 * half))
        value = builder.fadd(low, high)
    return value


def _paired(builder, first, second):
    """Sums of neighbours: first, second, first, second."""
    even = shuffled(builder, first, second, (0, 4, 2, 6))
    return builder.fadd(even, shuffled(builder, first, second, (1, 5, 3, 7)))


@intrinsic
def widest(typingctx, value):
    """Largest number of all lanes."""

    def generate(context, builder, signature, arguments):
        value, pick = arguments[0], extreme(">")
        for half in (8, 4, 2, 1):
            low = shuffled(builder, value, value, range(half))
            value = pick(builder, low, shuffled(builder, value, value, range(half, 2 * half)))
        return builder.extract_element(value, index(0))

    return types.float32(value), generate


@intrinsic
def store_sums(typingctx, array, place, first, second, third, fourth):
    """Put the sums over lanes of four values into a flat float32 array from a place on."""

    def generate(context, builder, signature, arguments):
        quarters = [_quarter(builder, value) for value in arguments[2:]]
        left, right = _paired(builder, *quarters[:2]), _paired(builder, *quarters[2:])
        low = shuffled(builder, left, right, (0, 1, 4, 5))
        sums = builder.fadd(low, shuffled(builder, left, right, (2, 3, 6, 7)))
        there = address(context, builder, array, arguments[:2], 4)
        builder.store(sums, there, align=4)

    return types.void(array, place, first, second, third, fourth), generate


@intrinsic
def load_triples(typingctx, array, first):
    """Sixteen triples of a flat float32 array from a place on, as three lanes."""

    def generate(context, builder, signature, arguments):
        there = address(context, builder, array, arguments, 3 * LANES)
        triples = builder.load(there, align=4)
        parts = [
            shuffled(builder, triples, triples, range(part, 3 * LANES, 3)) for part in range(3)
        ]
        return context.make_tuple(builder, signature.return_type, parts)

    return types.UniTuple(FLOATS, 3)(array, first), generate


@intrinsic
def store_triples(typingctx, array, place, first, second, third):
    """Put three lanes into a flat float32 array as sixteen triples."""

    def generate(context, builder, signature, arguments):
        pair = shuffled(builder, arguments[2], arguments[3], range(2 * LANES))
        last = shuffled(builder, arguments[4], arguments[4], [k % LANES for k in range(2 * LANES)])
        places = [part * LANES + lane for lane in range(LANES) for part in range(3)]
        there = address(context, builder, array, arguments[:2], 3 * LANES)
        builder.store(shuffled(builder, pair, last, places), there, align=4)

    return types.void(array, place, first, second, third), generate


@intrinsic
def prefetch(typingctx, array, first):
    """Ask for the cache line that holds a place of a flat float32 array."""

    def generate(context, builder, signature, arguments):
        there = address(context, builder, array, arguments, 1)
        byte, number = ir.IntType(8).as_pointer(), ir.IntType(32)
        kind = ir.FunctionType(ir.VoidType(), [byte, number, number, number])
        function = cgutils.get_or_insert_function(builder.module, kind, "llvm.prefetch.p0")
        reads, keeps, data = index(0), index(3), index(1)
        builder.call(function, [builder.bitcast(there, byte), reads, keeps, data])

    return types.void(array, first), generate


@numba.njit(**EXACT)
def lane_array(size: int) -> np.ndarray:
    """Room for float32 that begins where a cache line does: other lanes take twice as long."""
    room = np.empty(size + LANES, np.float32)
    first = -room.ctypes.data % 64 // 4
    return room[first : first + size]


@numba.njit(**EXACT)
def lane_exp(x: np.float32) -> np.float32:
    """exp(x) for -5.7 <= x <= 0, float32: a polynomial on x/8, squared three times."""
    y = x * EIGHTH
    value = ((((C5 * y + C4) * y + C3) * y + C2) * y + C1) * y + C0
    value *= value
    value *= value
    value *= value
    return value
