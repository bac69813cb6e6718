"""Adam on the rows that a step saw, and what the others missed: compiled code.

A row out of view has a gradient of zero: its moments fade, m by `BETA1` and v by `BETA2` a step,
and its parameters go on moving. A row is therefore kept as it was after its last gradient, and what
k missed steps did to it is found when it is wanted:

    sum over j = 1..k of  rate_j BETA1^j / (1 - BETA1^t_j)  *  m / (sqrt(v) d_j + eps),
    d_j = sqrt(BETA2^j / (1 - BETA2^t_j)),  t_j the number of the j-th missed step.

The weights and the d_j are the same for all rows that were left at the same step; m, v and eps are
not. So the sum is taken as a quadrature over d: runs of missed steps, the first ones of two steps,
later ones longer, are each replaced by two nodes with the run's moments 0 to 3 (Gauss' rule for a
discrete measure). Up to eight missed steps that is the sum itself. After `RUN_ENDS[-1]` steps the
terms are under 1e-11 of the first and are dropped. Every row is worked on alone, in float32:
threads change no bit.
"""

# ruff: noqa: ANN001, ANN202, PLR0913, SIM110 - numba infers these types

import math
from typing import Any, NamedTuple

import numba
import numpy as np
from torch import Tensor

from lidarpainter_models.kernels.sparse_adam import (
    BETA1,
    BETA2,
    MISSED_RUN_ENDS,
    AdamState,
    Parameters,
)

MEANS, LOG_SCALE = 0, 7
"""First of three columns each in a row of parameters; rotations lie between them."""
OPACITY, HARMONICS = 10, 11
RUN_ENDS = np.array(MISSED_RUN_ENDS)
CHUNKS = 64
"""Rows are shared out in this many chunks, whatever the number of threads."""

_VECTORS: dict[str, Any] = {
    "cache": True,
    "nogil": True,
    "fastmath": {"contract"},
    "error_model": "numpy",
}
"""A division that may raise cannot be part of a vector loop."""


def present_rows(state: AdamState, kept: Parameters, rows: Tensor, out: Parameters) -> None:
    """See `sparse_adam.present_rows`."""
    _present(
        _columns(kept),
        state.first.numpy(),
        state.second.numpy(),
        state.last.numpy(),
        rows.numpy(),
        _nodes(state, rows.numpy()),
        state.count,
        state.eps.numpy(),
        _columns(out),
    )


def step_rows(
    state: AdamState,
    kept: Parameters,
    rows: Tensor,
    seen: Parameters,
    gradients: Parameters,
    rates: list[float],
) -> None:
    """See `sparse_adam.step_rows`."""
    _step_rows(
        _columns(kept),
        state.first.numpy(),
        state.second.numpy(),
        state.last.numpy(),
        rows.numpy(),
        _columns(seen),
        _columns(gradients),
        np.array(rates)[state.kind_of_column.numpy()],
        state.count,
        state.eps.numpy(),
    )


def catch_up(state: AdamState, kept: Parameters) -> None:
    """See `sparse_adam.catch_up`."""
    _catch_up(
        _columns(kept),
        state.first.numpy(),
        state.second.numpy(),
        state.last.numpy(),
        _nodes(state, np.arange(len(state.last))),
        state.count,
        state.eps.numpy(),
    )


def _columns(parameters: Parameters) -> Parameters:
    """Parameters as arrays, harmonics (rows, numbers); a contiguous tensor's is its own memory."""
    arrays = [value.contiguous().numpy() for value in parameters]
    flat = [value.reshape(len(value), value.shape[1] * 3) for value in arrays[4:]]
    return Parameters._make((*arrays[:4], *flat))


class _Nodes(NamedTuple):
    """What stands for the missed steps, by the step at which a row was left."""

    weight: np.ndarray
    """(starts, nodes, columns): rates in it over the first moment's bias, shrunk with it."""
    depth: np.ndarray
    """(starts, nodes, columns): what sqrt(v) has shrunk to, over the second moment's bias."""
    lead: np.ndarray
    """(starts, nodes): part of a node's step after which the Gaussian has its mean size."""
    length: np.ndarray
    """(starts): number of nodes."""


def _nodes(state: AdamState, rows: np.ndarray) -> _Nodes:
    """What stands for the steps that these rows missed."""
    kind_of_column = state.kind_of_column.numpy()
    missed = np.array(state.missed).reshape(-1, int(kind_of_column[-1]) + 1)
    return _missed_nodes(state.last.numpy(), rows, missed, kind_of_column, state.count)


@numba.njit(cache=True, nogil=True)
def _pair(rates, left, begin, end):
    """Two nodes (weights, depths) with the moments of the missed steps `begin` to `end`."""
    total, mean, spread, skew = 0.0, 0.0, 0.0, 0.0
    for j in range(begin, end + 1):
        share = rates[j - 1] * BETA1**j / (1.0 - BETA1 ** (left + j))
        total += share
        mean += share * math.sqrt(BETA2**j / (1.0 - BETA2 ** (left + j)))
    mean /= total
    if begin == end:
        return total, mean, 0.0, mean
    for j in range(begin, end + 1):
        share = rates[j - 1] * BETA1**j / (1.0 - BETA1 ** (left + j))
        offset = math.sqrt(BETA2**j / (1.0 - BETA2 ** (left + j))) - mean
        spread += share * offset * offset
        skew += share * offset * offset * offset
    spread, middle = spread / total, 0.5 * skew / spread
    reach = math.sqrt(middle * middle + spread)
    near, far = middle + reach, middle - reach
    return -total * far / (near - far), mean + near, total * near / (near - far), mean + far


@numba.njit(cache=True, nogil=True)
def _missed_nodes(last, rows, rates, kind_of_column, now):
    """The nodes for every step at which one of the rows was left, up to the step `now`.

    `rates` holds those of the latest steps, (steps, kinds).
    """
    starts, columns = len(rates), len(kind_of_column)
    shape = (starts, 2 * len(RUN_ENDS), columns)
    weight, depth = np.zeros(shape, np.float32), np.ones(shape, np.float32)
    lead, length = np.zeros(shape[:2], np.float32), np.zeros(starts, np.int64)
    is_wanted = np.zeros(starts + 1, np.bool_)
    for row in rows:
        is_wanted[last[row] + starts - now] = True
    for start in range(starts):
        begin, place = 1, 0
        for run_end in RUN_ENDS:
            end = min(run_end, starts - start)
            if begin > end or not is_wanted[start]:
                break
            steps = end - begin + 1
            for kind in range(rates.shape[1]):
                pair = _pair(rates[start:, kind], now - starts + start, begin, end)
                for c in range(columns):
                    if kind_of_column[c] == kind:
                        weight[start, place, c], depth[start, place, c] = pair[0], pair[1]
                        weight[start, place + 1, c], depth[start, place + 1, c] = pair[2], pair[3]
            lead[start, place : place + 2] = 0.5 - min(steps, 2) / (2.0 * steps)
            # the second node of a run of one step weighs nothing
            begin, place = end + 1, place + min(steps, 2)
        length[start] = place
    return _Nodes(weight, depth, lead, length)


@numba.njit(cache=True, nogil=True)
def _load(parameters, row, out):
    """Copy one row of parameters into one array."""
    for c in range(3):
        out[MEANS + c] = parameters.means[row, c]
        out[LOG_SCALE + c] = parameters.log_scale[row, c]
    for c in range(4):
        out[MEANS + 3 + c] = parameters.rotation_wxyz[row, c]
    out[OPACITY] = parameters.opacity_logit[row]
    first = HARMONICS
    for part in (parameters.harmonics, parameters.more_harmonics):
        for c in range(part.shape[1]):
            out[first + c] = part[row, c]
        first += part.shape[1]


@numba.njit(cache=True, nogil=True)
def _store(values, parameters, row):
    """Copy one array into one row of parameters."""
    for c in range(3):
        parameters.means[row, c] = values[MEANS + c]
        parameters.log_scale[row, c] = values[LOG_SCALE + c]
    for c in range(4):
        parameters.rotation_wxyz[row, c] = values[MEANS + 3 + c]
    parameters.opacity_logit[row] = values[OPACITY]
    first = HARMONICS
    for part in (parameters.harmonics, parameters.more_harmonics):
        for c in range(part.shape[1]):
            part[row, c] = values[first + c]
        first += part.shape[1]


@numba.njit(**_VECTORS)
def _sigma_m(x, y, z):
    """Geometric mean of the two longer standard deviations, from their logarithms."""
    return np.float32(math.exp(np.float32(0.5) * (x + y + z - min(x, y, z))))


@numba.njit(**_VECTORS)
def _drift(values, first, second, nodes, start, eps, work):
    """Move one row by the steps it missed, in place; centres move in units of the size."""
    root, moved = work[0], work[1]
    for c in range(len(values)):
        root[c] = math.sqrt(second[c])
    a, b, c2 = LOG_SCALE, LOG_SCALE + 1, LOG_SCALE + 2
    x, y, z = values[MEANS], values[MEANS + 1], values[MEANS + 2]
    for k in range(nodes.length[start]):
        weight, depth = nodes.weight[start, k], nodes.depth[start, k]
        rest = np.float32(1.0) - nodes.lead[start, k]
        for c in range(len(values)):
            step = first[c] * weight[c] / (root[c] * depth[c] + eps[c])
            moved[c] = step
            values[c] -= step
        size_m = _sigma_m(
            values[a] + rest * moved[a], values[b] + rest * moved[b], values[c2] + rest * moved[c2]
        )
        x -= moved[MEANS] * size_m
        y -= moved[MEANS + 1] * size_m
        z -= moved[MEANS + 2] * size_m
    values[MEANS], values[MEANS + 1], values[MEANS + 2] = x, y, z


@numba.njit(cache=True, nogil=True, parallel=True)
def _present(kept, first, second, last, rows, nodes, now, eps, out):
    """Write the given rows as the steps they missed left them to `out`."""
    count, starts = len(rows), len(nodes.length)
    for chunk in numba.prange(CHUNKS):
        values, work = np.zeros(len(eps), np.float32), np.empty((2, len(eps)), np.float32)
        for k in range(chunk * count // CHUNKS, (chunk + 1) * count // CHUNKS):
            row = rows[k]
            _load(kept, row, values)
            if last[row] < now:
                start = last[row] + starts - now
                _drift(values, first[row], second[row], nodes, start, eps, work)
            _store(values, out, k)


@numba.njit(cache=True, nogil=True)
def _fade(first, second, missed):
    """Shrink the moments of one row by the steps it missed."""
    by_first, by_second = np.float32(BETA1**missed), np.float32(BETA2**missed)
    for c in range(len(first)):
        first[c] *= by_first
        second[c] *= by_second


@numba.njit(cache=True, nogil=True, parallel=True)
def _catch_up(kept, first, second, last, nodes, now, eps):
    """Bring every row and its moments up to the step `now`, in place."""
    count, starts = len(last), len(nodes.length)
    for chunk in numba.prange(CHUNKS):
        values, work = np.zeros(len(eps), np.float32), np.empty((2, len(eps)), np.float32)
        for row in range(chunk * count // CHUNKS, (chunk + 1) * count // CHUNKS):
            if last[row] < now:
                _load(kept, row, values)
                start = last[row] + starts - now
                _drift(values, first[row], second[row], nodes, start, eps, work)
                _store(values, kept, row)
                _fade(first[row], second[row], now - last[row])
                last[row] = now


@numba.njit(**_VECTORS)
def _step(values, gradient, first, second, rates, spread, eps):
    """Adam's step on one row, in place; `spread` is the square root of the second bias."""
    keep2, add1, add2 = np.float32(BETA2), np.float32(1 - BETA1), np.float32(1 - BETA2)
    size_m = _sigma_m(values[LOG_SCALE], values[LOG_SCALE + 1], values[LOG_SCALE + 2])
    for c in range(len(values)):
        g = gradient[c]
        first[c] += add1 * (g - first[c])
        second[c] = second[c] * keep2 + add2 * g * g
    for c in range(len(values)):  # a loop of its own: LLVM compares few arrays for overlap
        gradient[c] = rates[c] * first[c] / (np.float32(math.sqrt(second[c])) / spread + eps[c])
    for c in range(MEANS, MEANS + 3):
        gradient[c] *= size_m
    for c in range(len(values)):
        values[c] -= gradient[c]


@numba.njit(cache=True, nogil=True)
def _is_any(gradient):
    """Whether a number differs from zero."""
    for g in gradient:
        if g != 0.0:
            return True
    return False


@numba.njit(cache=True, nogil=True, parallel=True)
def _step_rows(kept, first, second, last, rows, seen, gradients, rates, now, eps):
    """Adam's step number `now` on the rows with a gradient, in place.

    `seen` holds the rows as `_present` gave them. A row whose gradient is zero throughout has
    missed this step as well.
    """
    count = len(rows)
    rates = (rates / (1.0 - BETA1**now)).astype(np.float32)
    spread = np.float32(math.sqrt(1.0 - BETA2**now))
    for chunk in numba.prange(CHUNKS):
        values, gradient = np.zeros(len(eps), np.float32), np.zeros(len(eps), np.float32)
        for k in range(chunk * count // CHUNKS, (chunk + 1) * count // CHUNKS):
            row = rows[k]
            _load(gradients, k, gradient)
            if not _is_any(gradient):
                continue
            _load(seen, k, values)
            if last[row] < now - 1:
                _fade(first[row], second[row], now - 1 - last[row])
            _step(values, gradient, first[row], second[row], rates, spread, eps)
            _store(values, kept, row)
            last[row] = now
