"""Several numbers at once as values of compiled code: sixteen float32, or eight float64.

Both fill a cache line, and LLVM cuts them into whatever registers the machine has (one AVX-512, two
AVX2, four NEON), so sums are taken in the same order on every machine. Operators work lane by lane
and spread scalars; a comparison gives a mask for `choose`.
"""

# ruff: noqa: ANN001, ANN201, ANN202, ARG001 - numba calls these with its own types and builders

import math
import operator
from typing import Any

from llvmlite import ir
from numba import extending, types
from numba.core import cgutils
from numba.extending import models, overload, register_model

intrinsic: Any = extending.intrinsic
"""Callers leave out the first argument of what it decorates, which no type checker knows."""

_FLAGS = ("contract", "nsz")  # fused multiply-add, otherwise as written


class MaskType(types.Type):
    """As many truth values as lanes."""

    def __init__(self, count: int) -> None:
        self.bits = ir.VectorType(ir.IntType(1), count)
        super().__init__(name=f"lane_mask_{count}")


class LaneType(types.Type):
    """As many numbers of one kind as fill a cache line."""

    def __init__(self, number: types.Float, element: ir.Type, mask: MaskType) -> None:
        self.number, self.mask, self.count = number, mask, mask.bits.count
        self.vector = ir.VectorType(element, self.count)
        super().__init__(name=f"lanes_{number}")


FLOATS = LaneType(types.float32, ir.FloatType(), MaskType(16))
DOUBLES = LaneType(types.float64, ir.DoubleType(), MaskType(8))
_OF_NUMBER: dict[types.Type, LaneType] = {kind.number: kind for kind in (FLOATS, DOUBLES)}
_OF_MASK = {kind.mask: kind for kind in (FLOATS, DOUBLES)}


@register_model(LaneType)
class _LaneModel(models.PrimitiveModel):
    def __init__(self, dmm, fe_type) -> None:
        super().__init__(dmm, fe_type, fe_type.vector)


@register_model(MaskType)
class _MaskModel(models.PrimitiveModel):
    def __init__(self, dmm, fe_type) -> None:
        super().__init__(dmm, fe_type, fe_type.bits)


def lanes_of(*kinds: types.Type) -> LaneType | None:
    """The lanes among these types, where the rest are such or numbers to be spread."""
    found = {kind for kind in kinds if isinstance(kind, LaneType)}
    numbers = [kind for kind in kinds if isinstance(kind, types.Float | types.Integer)]
    alike = len(found) == 1 and len(numbers) + kinds.count(*found) == len(kinds)
    return found.pop() if alike else None


def of_array(array: types.Array) -> LaneType:
    """What is read of such an array at once."""
    return _OF_NUMBER[array.dtype]


def index(number: int) -> ir.Constant:
    """A place within lanes."""
    return ir.Constant(ir.IntType(32), number)


def spread_to(lanes: LaneType, context, builder, value, kind):
    """A number in all lanes; lanes as they are."""
    if kind is lanes:
        return value
    single = context.cast(builder, value, kind, lanes.number)
    nothing = ir.Constant(lanes.vector, ir.Undefined)
    places = ir.Constant(ir.VectorType(ir.IntType(32), lanes.count), [index(0)] * lanes.count)
    start = builder.insert_element(nothing, single, index(0))
    return builder.shuffle_vector(start, nothing, places)


def spreading(lanes: LaneType):
    """An intrinsic that puts a number in all lanes."""

    @intrinsic
    def in_lanes(typingctx, value):
        def generate(context, builder, signature, arguments):
            return spread_to(lanes, context, builder, arguments[0], value)

        return lanes(value), generate

    return in_lanes


def shuffled(builder, first, second, places):
    """The lanes of two values at these places, the second's after the first's."""
    kind = ir.VectorType(ir.IntType(32), len(places))
    return builder.shuffle_vector(first, second, ir.Constant(kind, [index(p) for p in places]))


def address(context, builder, array_type, where, count):
    """Pointer to so many numbers of a contiguous array from a place on; both stand in `where`."""
    array, first = where
    data = context.make_array(array_type)(context, builder, array).data
    numbers = ir.VectorType(of_array(array_type).vector.element, count)
    return builder.bitcast(cgutils.gep_inbounds(builder, data, first), numbers.as_pointer())


def _lane_operation(emit, *, compares: bool = False):
    """An intrinsic of two operands, each of them lanes or a number."""

    @intrinsic
    def operation(typingctx, first, second):
        lanes = lanes_of(first, second)
        if lanes is None:
            return None

        def generate(context, builder, signature, arguments):
            pairs = zip(arguments, signature.args, strict=True)
            return emit(builder, *(spread_to(lanes, context, builder, *pair) for pair in pairs))

        return (lanes.mask if compares else lanes)(first, second), generate

    return operation


def _overload_operator(function, emit, *, compares: bool = False) -> None:
    operation = _lane_operation(emit, compares=compares)

    @overload(function)
    def typed(first, second):
        if lanes_of(first, second) is not None:
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
        _overload_operator(_function, _arithmetic(_name))
for _function, _sign in (
    (operator.ge, ">="),
    (operator.le, "<="),
    (operator.gt, ">"),
    (operator.lt, "<"),
):
    _overload_operator(_function, _comparison(_sign), compares=True)


def extreme(sign):
    """The larger or smaller of two lanes; the second where the first is NaN."""
    return lambda builder, first, second: builder.select(
        builder.fcmp_ordered(sign, first, second), first, second
    )


largest = _lane_operation(extreme(">"))
"""Lane-wise maximum."""
smallest = _lane_operation(extreme("<"))
"""Lane-wise minimum."""


def _of_each(emit):
    """An intrinsic of the lanes of one value."""

    @intrinsic
    def operation(typingctx, value):
        def generate(context, builder, signature, arguments):
            return emit(builder, arguments[0])

        return value(value), generate

    return operation


def _library_function(name):
    def emit(builder, value):
        element = "f64" if value.type.element == ir.DoubleType() else "f32"
        full_name = f"llvm.{name}.v{value.type.count}{element}"
        kind = ir.FunctionType(value.type, [value.type])
        function = cgutils.get_or_insert_function(builder.module, kind, full_name)
        return builder.call(function, [value])

    return emit


magnitude = _of_each(_library_function("fabs"))
"""Lane-wise absolute value."""
rounded_down = _of_each(_library_function("floor"))
"""Largest whole number up to each lane."""
_negated = _of_each(lambda builder, value: builder.fneg(value))
_roots = _of_each(_library_function("sqrt"))
_logarithms = _of_each(_library_function("log"))


@overload(operator.neg)
def _neg(value):
    return (lambda value: _negated(value)) if isinstance(value, LaneType) else None


@overload(math.sqrt)
def _sqrt(value):
    return (lambda value: _roots(value)) if isinstance(value, LaneType) else None


@overload(math.log)
def _log(value):
    return (lambda value: _logarithms(value)) if isinstance(value, LaneType) else None


@intrinsic
def choose(typingctx, mask, first, second):
    """First where the mask holds, else second."""
    lanes = _OF_MASK[mask]

    def generate(context, builder, signature, arguments):
        kinds = signature.args
        chosen = (spread_to(lanes, context, builder, arguments[k], kinds[k]) for k in (1, 2))
        return builder.select(arguments[0], *chosen)

    return lanes(mask, first, second), generate


@overload(operator.and_)
def _both(first, second):
    if isinstance(first, MaskType) and first == second:
        return lambda first, second: _where_both(first, second)
    return None


@intrinsic
def _where_both(typingctx, first, second):
    def generate(context, builder, signature, arguments):
        return builder.and_(*arguments)

    return first(first, second), generate


@intrinsic
def any_of(typingctx, mask):
    """Whether a mask holds anywhere."""

    def generate(context, builder, signature, arguments):
        number = ir.IntType(mask.bits.count)
        held = builder.bitcast(arguments[0], number)
        return builder.icmp_unsigned("!=", held, ir.Constant(number, 0))

    return types.boolean(mask), generate


@intrinsic
def load(typingctx, array, first):
    """As many numbers of a contiguous array as there are lanes; the caller keeps to its length."""
    lanes = of_array(array)

    def generate(context, builder, signature, arguments):
        there = address(context, builder, array, arguments, lanes.count)
        return builder.load(there, align=lanes.number.bitwidth // 8)

    return lanes(array, first), generate


@intrinsic
def store(typingctx, array, first, value):
    """Put lanes, or a number as often, into a contiguous array from a place on."""
    lanes = of_array(array)

    def generate(context, builder, signature, arguments):
        there = address(context, builder, array, arguments[:2], lanes.count)
        spread = spread_to(lanes, context, builder, arguments[2], value)
        builder.store(spread, there, align=lanes.number.bitwidth // 8)

    return types.void(array, first, value), generate
