"""Sixteen float32 numbers at once, as values of compiled code: a row of a screen tile.

The loops over pixels are written in these and not left to the compiler's loop vectoriser, which
pays for every short loop with a scalar remainder and keeps no sums in registers between rows. LLVM
cuts sixteen lanes into whatever the machine has (one AVX-512, two AVX2, four NEON registers), so
sums are taken in the same order on every machine. Operators work lane by lane and spread scalars;
a comparison gives a mask for `choose`.
"""

# ruff: noqa: ANN001, ANN201, ANN202, ARG001 - numba calls these with its own types and builders

import operator
from typing import Any

import numba
import numpy as np
from llvmlite import ir
from numba import extending, types
from numba.core import cgutils
from numba.extending import models, overload, register_model

from lidarpainter_models.kernels.gaussian_raster.compilation import EXACT

intrinsic: Any = extending.intrinsic
"""Callers leave out the first argument of what it decorates, which no type checker knows."""

LANES = 16
_VECTOR = ir.VectorType(ir.FloatType(), LANES)
_BITS = ir.VectorType(ir.IntType(1), LANES)
_FLAGS = ("contract", "nsz")  # fused multiply-add, otherwise as written
EIGHTH = np.float32(0.125)
# minimax in relative error over the exponents that survive the alpha cut, divided by eight
C0 = np.float32(0.99999994)
C1 = np.float32(0.99999183)
C2 = np.float32(0.49987432)
C3 = np.float32(0.16593865)
C4 = np.float32(0.03971106)
C5 = np.float32(0.0058094156)


class _Lanes(types.Type):
    """Sixteen float32."""

    def __init__(self) -> None:
        super().__init__(name="lanes")


class _Mask(types.Type):
    """Sixteen truth values."""

    def __init__(self) -> None:
        super().__init__(name="lane_mask")


_LANES, _MASK = _Lanes(), _Mask()


@register_model(_Lanes)
class _LanesModel(models.PrimitiveModel):
    def __init__(self, dmm, fe_type) -> None:
        super().__init__(dmm, fe_type, _VECTOR)


@register_model(_Mask)
class _MaskModel(models.PrimitiveModel):
    def __init__(self, dmm, fe_type) -> None:
        super().__init__(dmm, fe_type, _BITS)


def _spread(context, builder, value, kind):
    """A number in all lanes; lanes as they are."""
    if kind is _LANES:
        return value
    single = context.cast(builder, value, kind, types.float32)
    start = builder.insert_element(ir.Constant(_VECTOR, ir.Undefined), single, _index(0))
    places = ir.Constant(ir.VectorType(ir.IntType(32), LANES), [_index(0)] * LANES)
    return builder.shuffle_vector(start, ir.Constant(_VECTOR, ir.Undefined), places)


def _index(number):
    return ir.Constant(ir.IntType(32), number)


def _is_number(kind):
    return isinstance(kind, types.Float | types.Integer)


def _lane_operation(emit, result):
    """An intrinsic of two operands, each of them lanes or a number."""

    @intrinsic
    def operation(typingctx, first, second):
        def generate(context, builder, signature, arguments):
            pairs = zip(arguments, signature.args, strict=True)
            return emit(builder, *(_spread(context, builder, *pair) for pair in pairs))

        return result(first, second), generate

    return operation


def _overload_operator(function, emit, result) -> None:
    operation = _lane_operation(emit, result)

    @overload(function)
    def typed(first, second):
        kinds = (first, second)
        if _LANES in kinds and all(kind is _LANES or _is_number(kind) for kind in kinds):
            return lambda first, second: operation(first, second)
        return None


def _arithmetic(name):
    return lambda builder, first, second: getattr(builder, name)(first, second, flags=_FLAGS)


def _comparison(sign):
    return lambda builder, first, second: builder.fcmp_ordered(sign, first, second)


for _functions, _name in (
    ((operator.add, operator.iadd), "fadd"),
    ((operator.sub, operator.isub), "fsub"),
    ((operator.mul, operator.imul), "fmul"),
    ((operator.truediv, operator.itruediv), "fdiv"),
):
    for _function in _functions:
        _overload_operator(_function, _arithmetic(_name), _LANES)
for _function, _sign in ((operator.ge, ">="), (operator.le, "<="), (operator.gt, ">")):
    _overload_operator(_function, _comparison(_sign), _MASK)


def _extreme(sign):
    """The larger or smaller of two lanes; the second where the first is NaN."""
    return lambda builder, first, second: builder.select(
        builder.fcmp_ordered(sign, first, second), first, second
    )


largest = _lane_operation(_extreme(">"), _LANES)
"""Lane-wise maximum."""
smallest = _lane_operation(_extreme("<"), _LANES)
"""Lane-wise minimum."""


@intrinsic
def choose(typingctx, mask, first, second):
    """First where the mask holds, else second."""

    def generate(context, builder, signature, arguments):
        kinds = signature.args
        chosen = (_spread(context, builder, arguments[k], kinds[k]) for k in (1, 2))
        return builder.select(arguments[0], *chosen)

    return _LANES(mask, first, second), generate


@intrinsic
def magnitude(typingctx, value):
    """Lane-wise absolute value."""

    def generate(context, builder, signature, arguments):
        bits = ir.VectorType(ir.IntType(32), LANES)
        without_sign = ir.Constant(bits, [_index(0x7FFFFFFF)] * LANES)
        return builder.bitcast(
            builder.and_(builder.bitcast(arguments[0], bits), without_sign), _VECTOR
        )

    return _LANES(value), generate


@intrinsic
def lane_centres(typingctx):
    """0.5, 1.5, ... 15.5: pixel centres of a tile row."""

    def generate(context, builder, signature, arguments):
        single = ir.FloatType()
        return ir.Constant(_VECTOR, [ir.Constant(single, k + 0.5) for k in range(LANES)])

    return _LANES(), generate


@intrinsic
def spread(typingctx, value):
    """A number in all lanes."""

    def generate(context, builder, signature, arguments):
        return _spread(context, builder, arguments[0], signature.args[0])

    return _LANES(value), generate


def _address(context, builder, array_type, array, first, *, lanes=LANES):
    """Pointer to `lanes` numbers of a flat, contiguous array from `first` on."""
    data = context.make_array(array_type)(context, builder, array).data
    pointer = cgutils.gep_inbounds(builder, data, first)
    return builder.bitcast(pointer, ir.VectorType(ir.FloatType(), lanes).as_pointer())


@intrinsic
def load(typingctx, array, first):
    """Sixteen numbers of a flat float32 array from a place on; the caller keeps to its length."""

    def generate(context, builder, signature, arguments):
        address = _address(context, builder, signature.args[0], *arguments)
        return builder.load(address, align=4)

    return _LANES(array, first), generate


@intrinsic
def store(typingctx, array, first, value):
    """Put sixteen numbers into a flat float32 array from a place on."""

    def generate(context, builder, signature, arguments):
        array_type, _, kind = signature.args
        address = _address(context, builder, array_type, arguments[0], arguments[1])
        builder.store(_spread(context, builder, arguments[2], kind), address, align=4)

    return types.void(array, first, value), generate


def _shuffled(builder, first, second, places):
    kind = ir.VectorType(ir.IntType(32), len(places))
    return builder.shuffle_vector(first, second, ir.Constant(kind, [_index(p) for p in places]))


def _quarter(builder, value):
    """Four partial sums of sixteen lanes."""
    for half in (LANES // 2, LANES // 4):
        low = _shuffled(builder, value, value, range(half))
        high = _shuffled(builder, value, value, range(half, 2 * half))
        value = builder.fadd(low, high)
    return value


def _paired(builder, first, second):
    """Sums of neighbours: first, second, first, second."""
    even = _shuffled(builder, first, second, (0, 4, 2, 6))
    return builder.fadd(even, _shuffled(builder, first, second, (1, 5, 3, 7)))


@intrinsic
def widest(typingctx, value):
    """Largest number of all lanes."""

    def generate(context, builder, signature, arguments):
        value, pick = arguments[0], _extreme(">")
        for half in (8, 4, 2, 1):
            low = _shuffled(builder, value, value, range(half))
            value = pick(builder, low, _shuffled(builder, value, value, range(half, 2 * half)))
        return builder.extract_element(value, _index(0))

    return types.float32(value), generate


@intrinsic
def store_sums(typingctx, array, place, first, second, third, fourth):
    """Put the sums over lanes of four values into a flat float32 array from a place on."""

    def generate(context, builder, signature, arguments):
        quarters = [_quarter(builder, value) for value in arguments[2:]]
        left, right = _paired(builder, *quarters[:2]), _paired(builder, *quarters[2:])
        low = _shuffled(builder, left, right, (0, 1, 4, 5))
        sums = builder.fadd(low, _shuffled(builder, left, right, (2, 3, 6, 7)))
        array_type = signature.args[0]
        address = _address(context, builder, array_type, arguments[0], arguments[1], lanes=4)
        builder.store(sums, address, align=4)

    return types.void(array, place, first, second, third, fourth), generate


@intrinsic
def load_triples(typingctx, array, first):
    """Sixteen triples of a flat float32 array from a place on, as three lanes."""

    def generate(context, builder, signature, arguments):
        address = _address(context, builder, signature.args[0], *arguments, lanes=3 * LANES)
        triples = builder.load(address, align=4)
        parts = [
            _shuffled(builder, triples, triples, range(part, 3 * LANES, 3)) for part in range(3)
        ]
        return context.make_tuple(builder, signature.return_type, parts)

    return types.UniTuple(_LANES, 3)(array, first), generate


@intrinsic
def store_triples(typingctx, array, place, first, second, third):
    """Put three lanes into a flat float32 array as sixteen triples."""

    def generate(context, builder, signature, arguments):
        pair = _shuffled(builder, arguments[2], arguments[3], range(2 * LANES))
        last = _shuffled(builder, arguments[4], arguments[4], [k % LANES for k in range(2 * LANES)])
        places = [part * LANES + lane for lane in range(LANES) for part in range(3)]
        address = _address(context, builder, signature.args[0], *arguments[:2], lanes=3 * LANES)
        builder.store(_shuffled(builder, pair, last, places), address, align=4)

    return types.void(array, place, first, second, third), generate


@intrinsic
def prefetch(typingctx, array, first):
    """Ask for the cache line that holds a place of a flat float32 array."""

    def generate(context, builder, signature, arguments):
        address = _address(context, builder, signature.args[0], *arguments)
        byte, number = ir.IntType(8).as_pointer(), ir.IntType(32)
        kind = ir.FunctionType(ir.VoidType(), [byte, number, number, number])
        function = cgutils.get_or_insert_function(builder.module, kind, "llvm.prefetch.p0")
        reads, keeps, data = _index(0), _index(3), _index(1)
        builder.call(function, [builder.bitcast(address, byte), reads, keeps, data])

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
