"""Adam on blocks of rows, all parameters of a row side by side as in its moments.

The arithmetic is that of the numba twin (`cpu`). Parameters are tuples of the six pointers of
`Parameters`, of which the harmonics have `WIDTH` and `MORE` columns.
"""

import math

import triton
import triton.language as tl

from lidarpainter_models.kernels import sparse_adam
from lidarpainter_models.kernels.sparse_adam import device_rates

BETA1, BETA2 = tl.constexpr(sparse_adam.BETA1), tl.constexpr(sparse_adam.BETA2)
LOG1, LOG2 = tl.constexpr(math.log(sparse_adam.BETA1)), tl.constexpr(math.log(sparse_adam.BETA2))
NUMBERS = tl.constexpr(device_rates.NODE_NUMBERS)
RUNS = tl.constexpr(len(sparse_adam.MISSED_RUN_ENDS))
KINDS = tl.constexpr(device_rates.KINDS)
LOG_SCALE = tl.constexpr(7)
"""First of three columns, as the means' is 0; rotations lie between them."""


@triton.jit(do_not_specialize=["missed_steps", "now"])
def write_nodes(rates, run_ends, nodes, missed_steps, now, BLOCK: tl.constexpr):
    """Write the nodes of one run of missed steps, for a block of rows' numbers of missed steps.

    `rates` are those of the latest steps up to `now`; `nodes` is by missed steps (from one on),
    run, number and kind; `missed_steps` is the most that a row may have missed.
    """
    place = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    run = tl.program_id(1)
    missed = tl.minimum(place + 1, missed_steps)
    kind = tl.arange(0, triton.next_power_of_2(KINDS))
    begin, end = tl.load(run_ends + run) + 1, tl.load(run_ends + run + 1)
    fade1, fade2 = tl.exp(begin.to(tl.float64) * LOG1), tl.exp(begin.to(tl.float64) * LOG2)
    number = (now - missed + begin).to(tl.float64)
    bias1, bias2 = tl.exp(number * LOG1), tl.exp(number * LOG2)
    origin = tl.sqrt(fade2 / (1.0 - bias2))
    # moments of the depths about the first one, weighed by the shares
    total = tl.full([BLOCK, kind.shape[0]], 0.0, tl.float64)
    first, second, third, steps = total, total, total, total
    rate = rates + (missed_steps - missed + begin - 1)[:, None] * KINDS + kind[None, :]
    is_kind = (kind < KINDS)[None, :]
    j, last = begin, tl.minimum(end, tl.max(missed, axis=0))
    while j <= last:
        share = tl.load(rate, mask=(missed >= j)[:, None] & is_kind, other=0.0).to(tl.float64)
        share *= (fade1 / (1.0 - bias1))[:, None]
        offset = (tl.sqrt(fade2 / (1.0 - bias2)) - origin)[:, None]
        steps += tl.where(share > 0.0, 1.0, 0.0)
        total += share
        share *= offset
        first += share
        share *= offset
        second += share
        third += share * offset
        fade1, bias1 = fade1 * BETA1, bias1 * BETA1
        fade2, bias2 = fade2 * BETA2, bias2 * BETA2
        rate += KINDS
        j += 1
    safe = tl.where(total > 0.0, total, 1.0)
    first, second, third = first / safe, second / safe, third / safe
    mean = origin[:, None] + first
    is_pair = steps > 1.0
    spread = tl.where(is_pair, second - first * first, 1.0)
    skew = third - 3.0 * first * second + 2.0 * first * first * first
    middle = tl.where(is_pair, 0.5 * skew / spread, 0.0)
    reach = tl.sqrt(middle * middle + spread)
    near, far = middle + reach, middle - reach
    out = nodes + (place.to(tl.int64)[:, None] * RUNS + run) * NUMBERS * KINDS + kind[None, :]
    exists = (place < missed_steps)[:, None] & is_kind
    weight = tl.where(is_pair, -total * far / (near - far), total)
    tl.store(out, weight.to(tl.float32), mask=exists)
    depth = tl.where(is_pair, mean + near, mean)
    tl.store(out + KINDS, depth.to(tl.float32), mask=exists)
    weight = tl.where(is_pair, total * near / (near - far), 0.0)
    tl.store(out + 2 * KINDS, weight.to(tl.float32), mask=exists)
    depth = tl.where(is_pair, mean + far, 1.0)
    tl.store(out + 3 * KINDS, depth.to(tl.float32), mask=exists)


@triton.jit
def _load(parameters, row, exists, column, WIDTH: tl.constexpr, MORE: tl.constexpr):
    """Rows of parameters, with zeros in the columns that they lack."""
    counts = (3, 4, 3, 1, WIDTH, MORE)
    values, place = tl.full([row.shape[0], column.shape[0]], 0.0, tl.float32), column[None, :]
    for part in tl.static_range(KINDS):
        its = exists[:, None] & (place >= 0) & (place < counts[part])
        at = parameters[part] + row[:, None] * counts[part] + place
        values += tl.load(at, mask=its, other=0.0)
        place -= counts[part]
    return values


@triton.jit
def _store(values, parameters, row, exists, column, WIDTH: tl.constexpr, MORE: tl.constexpr):
    """Write rows of parameters."""
    counts, place = (3, 4, 3, 1, WIDTH, MORE), column[None, :]
    for part in tl.static_range(KINDS):
        its = exists[:, None] & (place >= 0) & (place < counts[part])
        tl.store(parameters[part] + row[:, None] * counts[part] + place, values, mask=its)
        place -= counts[part]


@triton.jit
def _in_units(move, values, column):
    """Moves with those of centres in units of the size: the mean of the two longer deviations."""
    is_scale = ((column >= LOG_SCALE) & (column < LOG_SCALE + 3))[None, :]
    total = tl.sum(tl.where(is_scale, values, 0.0), axis=1)
    least = tl.min(tl.where(is_scale, values, float("inf")), axis=1)
    size_m = tl.exp(0.5 * (total - least))
    return tl.where((column < 3)[None, :], move * size_m[:, None], move)


@triton.jit
def _drift(values, moments, missed, column, tables, COLUMNS: tl.constexpr):
    """Rows after the steps they missed."""
    first, second, exists = moments
    nodes, run_ends, kind_of_column, eps = tables
    kind = tl.load(kind_of_column + column, mask=column < COLUMNS, other=0).to(tl.int32)
    eps = tl.load(eps + column, mask=column < COLUMNS, other=1.0)[None, :]
    root = tl.sqrt(second)
    place = tl.maximum(missed - 1, 0).to(tl.int64) * (RUNS * NUMBERS * KINDS)
    node = nodes + place[:, None] + kind[None, :]
    most = tl.max(missed, axis=0)
    run, begin = 0, 1
    while (run < RUNS) & (begin <= most):
        end = tl.load(run_ends + run + 1)
        takes = exists & (missed >= begin)[:, None]
        # part of a node's move after which the Gaussian has its mean size
        steps = tl.maximum(tl.minimum(missed, end) - begin + 1, 1).to(tl.float32)
        lead = 0.5 - tl.minimum(steps, 2.0) / (2.0 * steps)
        for later in tl.static_range(2):
            weight = tl.load(node + 2 * later * KINDS, mask=takes, other=0.0)
            depth = tl.load(node + (2 * later + 1) * KINDS, mask=takes, other=1.0)
            move = first * weight / (root * depth + eps)
            values -= _in_units(move, values - lead[:, None] * move, column)
        node += NUMBERS * KINDS
        run, begin = run + 1, end + 1
    return values


@triton.jit
def _faded(first, second, missed):
    """Moments after a number of steps without a gradient."""
    steps = missed.to(tl.float64)
    by_first, by_second = tl.exp(steps * LOG1).to(tl.float32), tl.exp(steps * LOG2).to(tl.float32)
    return first * by_first[:, None], second * by_second[:, None]


@triton.jit
def _moments(first, second, row, exists, column, COLUMNS: tl.constexpr):
    """Rows of moments, where they lie, and which entries there are."""
    exists = exists[:, None] & (column < COLUMNS)[None, :]
    place = row[:, None] * COLUMNS + column[None, :]
    first = tl.load(first + place, mask=exists, other=0.0)
    return first, tl.load(second + place, mask=exists, other=0.0), place, exists


@triton.jit(do_not_specialize=["count", "now"])
def present(
    kept,
    out,
    first,
    second,
    last,
    rows,
    nodes,
    run_ends,
    kind_of_column,
    eps,
    count,
    now,
    KEPT: tl.constexpr,
    KEPT_MORE: tl.constexpr,
    OUT: tl.constexpr,
    OUT_MORE: tl.constexpr,
    COLUMNS: tl.constexpr,
    ROOM: tl.constexpr,
    BLOCK: tl.constexpr,
):
    """Write the given rows of the kept parameters, moved by the steps they missed, to `out`.

    `last` is the step after which each row was left. A program has `ROOM` columns for the
    `COLUMNS` of the moments; `KEPT` to `OUT_MORE` are those of harmonics and further ones.
    """
    column = tl.arange(0, ROOM)
    place = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    exists = place < count
    row = tl.load(rows + place, mask=exists, other=0).to(tl.int64)
    missed = now - tl.load(last + row, mask=exists, other=now)
    values = _load(kept, row, exists, column, KEPT, KEPT_MORE)
    m, v, _, is_moment = _moments(first, second, row, exists, column, COLUMNS)
    tables = (nodes, run_ends, kind_of_column, eps)
    values = _drift(values, (m, v, is_moment), missed, column, tables, COLUMNS)
    _store(values, out, place.to(tl.int64), exists, column, OUT, OUT_MORE)


@triton.jit(do_not_specialize=["count", "now"])
def catch_up_rows(
    kept,
    first,
    second,
    last,
    nodes,
    run_ends,
    kind_of_column,
    eps,
    count,
    now,
    KEPT: tl.constexpr,
    KEPT_MORE: tl.constexpr,
    COLUMNS: tl.constexpr,
    ROOM: tl.constexpr,
    BLOCK: tl.constexpr,
):
    """Bring all rows and their moments up to the step `now`, in place; arguments of `present`."""
    column = tl.arange(0, ROOM)
    row = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    missed = now - tl.load(last + row, mask=row < count, other=now)
    lags = missed > 0
    values = _load(kept, row, lags, column, KEPT, KEPT_MORE)
    m, v, place, is_moment = _moments(first, second, row, lags, column, COLUMNS)
    tables = (nodes, run_ends, kind_of_column, eps)
    values = _drift(values, (m, v, is_moment), missed, column, tables, COLUMNS)
    tl.debug_barrier()  # every warp has read `last`, of which each reads all
    _store(values, kept, row, lags, column, KEPT, KEPT_MORE)
    m, v = _faded(m, v, missed)
    tl.store(first + place, m, mask=is_moment)
    tl.store(second + place, v, mask=is_moment)
    tl.store(last + row, tl.full([BLOCK], 0, tl.int32) + now, mask=lags)


@triton.jit(do_not_specialize=["count", "now", "filled"])
def step(
    kept,
    seen,
    gradients,
    rates,
    first,
    second,
    last,
    rows,
    kept_rates,
    kind_of_column,
    eps,
    count,
    now,
    filled,
    growth,
    spread,
    KEPT: tl.constexpr,
    KEPT_MORE: tl.constexpr,
    SEEN: tl.constexpr,
    SEEN_MORE: tl.constexpr,
    COLUMNS: tl.constexpr,
    ROOM: tl.constexpr,
    BLOCK: tl.constexpr,
):
    """Adam's step number `now` on the given rows with a gradient, in place; its rates are kept.

    A row whose gradient is zero throughout has missed this step as well. `seen` is as `present`
    wrote it; the rates go to row `filled` of `kept_rates`; `growth` is one over the first moment's
    bias, `spread` the square root of the second's. For the rest see `present`.
    """
    column = tl.arange(0, ROOM)
    kind = tl.load(kind_of_column + column, mask=column < COLUMNS, other=0)
    rate = tl.full([ROOM], 0.0, tl.float32)
    for k in tl.static_range(KINDS):
        rate = tl.where(kind == k, rates[k], rate)
        tl.store(kept_rates + filled * KINDS + k, rates[k], mask=tl.program_id(0) == 0)
    place = (tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)).to(tl.int64)
    exists = place < count
    gradient = _load(gradients, place, exists, column, SEEN, SEEN_MORE)
    moves = exists & (tl.max(tl.where(gradient != 0.0, 1, 0), axis=1) > 0)
    row = tl.load(rows + place, mask=moves, other=0).to(tl.int64)
    values = _load(seen, place, moves, column, SEEN, SEEN_MORE)
    m, v, there, is_moment = _moments(first, second, row, moves, column, COLUMNS)
    m, v = _faded(m, v, now - 1 - tl.load(last + row, mask=moves, other=now - 1))
    m += (1 - BETA1) * (gradient - m)
    v = v * BETA2 + (1 - BETA2) * gradient * gradient
    eps = tl.load(eps + column, mask=column < COLUMNS, other=1.0)
    move = (rate * growth)[None, :] * m / (tl.sqrt(v) / spread + eps[None, :])
    values -= _in_units(move, values, column)
    tl.debug_barrier()  # every warp has read `last`, of which each reads all
    _store(values, kept, row, moves, column, KEPT, KEPT_MORE)
    tl.store(first + there, m, mask=is_moment)
    tl.store(second + there, v, mask=is_moment)
    tl.store(last + row, tl.full([BLOCK], 0, tl.int32) + now, mask=moves)
