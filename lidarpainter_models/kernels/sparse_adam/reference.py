"""Adam on rows in plain torch, on any device: the law in float64, the twin of numba in float32.

At step t a row has m = BETA1 m + (1 - BETA1) g and v = BETA2 v + (1 - BETA2) g^2 and moves by
rate m / (1 - BETA1^t) over sqrt(v / (1 - BETA2^t)) + eps; without a gradient, g is 0. Rows are
sorted by how much they missed, so that the device is asked once how many there are of each. What
they missed is taken in float64 every step by itself, in float32 a few at once: a row that missed k
steps moves by the sum over j = 1..k of

    rate_j BETA1^j / (1 - BETA1^t_j)  *  m / (sqrt(v) d_j + eps),
    d_j = sqrt(BETA2^j / (1 - BETA2^t_j)),  t_j the number of the j-th missed step.

Tables hold weights and depths d by how many steps were missed; see `cpu` for why a run of steps
can be replaced by two nodes with its moments 0 to 3.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from lidarpainter_models.kernels.sparse_adam import (
    BETA1,
    BETA2,
    MISSED_RUN_ENDS,
    AdamState,
    Parameters,
)

_MEANS, _LOG_SCALE = slice(0, 3), slice(7, 10)


def present_rows(
    state: AdamState, kept: Parameters, rows: Int[Tensor, " seen"], out: Parameters
) -> None:
    """See `sparse_adam.present_rows`."""
    values = _table(state, Parameters(*(value.index_select(0, rows) for value in kept)))
    _catch_up(state, values, rows)
    _store(_split(values, out), out)


def step_rows(
    state: AdamState,
    kept: Parameters,
    rows: Int[Tensor, " seen"],
    seen: Parameters,
    gradients: Parameters,
    rates: list[float],
) -> None:
    """See `sparse_adam.step_rows`."""
    # without a gradient too: it is what the row would have to catch up with, and a choice by mask
    # would wait for the device
    gradient = _table(state, gradients)
    steps = (state.count - state.last.index_select(0, rows))[:, None].to(gradient.dtype)
    first = state.first.index_select(0, rows).mul_(BETA1**steps)
    second = state.second.index_select(0, rows).mul_(BETA2**steps)
    first.add_(gradient, alpha=1 - BETA1)
    second.addcmul_(gradient, gradient, value=1 - BETA2)
    state.first.index_copy_(0, rows, first)
    state.second.index_copy_(0, rows, second)
    state.last.index_fill_(0, rows, state.count)
    # the second moment's bias in the rate, and in what is added for its sake
    bias = math.sqrt(1 - BETA2**state.count)
    rate = torch.tensor(rates, dtype=torch.float64) * (bias / (1 - BETA1**state.count))
    spread = second.sqrt_().add_(state.eps, alpha=bias)
    move = first.mul_(_by_column(state, rate, gradient.dtype)).div_(spread)
    move = _in_units(move, seen.log_scale)
    _store(_split(_table(state, seen).sub_(move), kept), kept, rows)


def catch_up(state: AdamState, kept: Parameters) -> None:
    """See `sparse_adam.catch_up`."""
    values = _table(state, kept)
    _catch_up(state, values, None)
    _store(_split(values, kept), kept)
    faded = (state.count - state.last)[:, None].to(values.dtype)
    state.first.mul_(BETA1**faded)
    state.second.mul_(BETA2**faded)
    state.last.fill_(state.count)


def _catch_up(
    state: AdamState, values: Float[Tensor, "rows columns"], rows: Int[Tensor, " rows"] | None
) -> None:
    """Move a table of parameters by the steps that its rows (None: all) missed, in place."""
    most = len(state.missed)
    last = state.last if rows is None else state.last.index_select(0, rows)
    missed = (state.count - last).long()
    ones = torch.ones_like(missed)
    of_each = ones.new_zeros(most + 1).index_add_(0, missed, ones)
    at_least = of_each.flip(0).cumsum(0).flip(0).tolist()  # the host waits here, once
    if most == 0 or at_least[1] == 0:
        return
    stale = missed.argsort(descending=True)[: at_least[1]]
    missed = missed.index_select(0, stale)
    places = stale if rows is None else rows.index_select(0, stale)
    first, root = state.first.index_select(0, places), state.second.index_select(0, places).sqrt_()
    moved_to = values.index_select(0, stale)
    steps = (single_steps if values.dtype == torch.float64 else gathered_steps)(
        state.missed, state.count
    )
    weight, depth = (
        _by_column(state, torch.from_numpy(table), values.dtype)
        for table in (steps.weight, steps.depth)
    )
    leads = torch.from_numpy(steps.lead).to(values.dtype).to(values.device, non_blocking=True)
    for node, least in enumerate(steps.least):
        count = at_least[least] if least <= most else 0
        if count == 0:
            break
        begun = missed[:count]
        move = weight[node].index_select(0, begun).mul_(first[:count])
        move /= depth[node].index_select(0, begun).mul_(root[:count]).add_(state.eps)
        lead = leads[node].index_select(0, begun)
        moved_to[:count] -= _in_units(move, moved_to[:count, _LOG_SCALE], lead)
    values[stale] = moved_to


def _in_units(
    move: Float[Tensor, "rows columns"],
    log_scale: Float[Tensor, "rows 3"],
    lead: Float[Tensor, " rows"] | None = None,
) -> Float[Tensor, "rows columns"]:
    """Moves with those of centres in units of the Gaussian's size, in place."""
    if lead is not None:
        log_scale = log_scale - lead[:, None] * move[:, _LOG_SCALE]
    size_m = (0.5 * (log_scale.sum(dim=1) - log_scale.amin(dim=1))).exp()
    move[:, _MEANS] *= size_m[:, None]
    return move


def _by_column(
    state: AdamState, by_kind: Float[Tensor, "*batch kinds"], dtype: torch.dtype
) -> Float[Tensor, "*batch columns"]:
    """A number of each column from those of the kinds of parameters, on the moments' device."""
    there = by_kind.to(dtype).to(state.first.device, non_blocking=True)
    return there.index_select(-1, state.kind_of_column)


def _table(state: AdamState, parameters: Parameters) -> Float[Tensor, "rows columns"]:
    """All parameters side by side, with zeros where a row of moments is longer."""
    count = len(parameters.means)
    parts = [value.reshape(count, value.shape[1:].numel()) for value in parameters]
    missing = state.first.shape[1] - sum(part.shape[1] for part in parts)
    return torch.cat([*parts, parts[0].new_zeros(count, missing)], dim=1)


def _split(table: Float[Tensor, "rows columns"], like: Parameters) -> list[Tensor]:
    """The columns of a table as those parameters."""
    widths = [value.shape[1:].numel() for value in like]
    parts = table.split([*widths, table.shape[1] - sum(widths)], dim=1)
    return [
        part.reshape(len(table), *value.shape[1:]) for part, value in zip(parts, like, strict=False)
    ]


def _store(
    parts: Sequence[Tensor], out: Parameters, rows: Int[Tensor, " seen"] | None = None
) -> None:
    """Write values into rows of parameters, or into all."""
    for value, part in zip(out, parts, strict=True):
        if rows is None:
            value.copy_(part)
        else:
            value.index_copy_(0, rows, part)


class MissedSteps(NamedTuple):
    """Nodes in their order; a row takes part from the first on that it missed steps enough for."""

    weight: Float[np.ndarray, "nodes missed kinds"]
    depth: Float[np.ndarray, "nodes missed kinds"]
    least: list[int]
    """The number of missed steps from which on each node counts, ascending."""
    lead: Float[np.ndarray, "nodes missed"]
    """Part of a node's move after which the Gaussian has its mean size."""


def single_steps(rates: list[list[float]], now: int) -> MissedSteps:
    """Every missed step by itself; `rates` are those of the latest steps up to `now`."""
    share, depth = _steps(np.array(rates), now)
    count = len(rates)
    return MissedSteps(share, depth, [*range(1, count + 1)], np.zeros((count, count + 1)))


def gathered_steps(rates: list[list[float]], now: int) -> MissedSteps:
    """Runs of missed steps, each as two nodes; exact up to eight missed steps."""
    share, depth = _steps(np.array(rates), now)
    weights, depths, least, lead = [], [], [], []
    begin = 1
    for end in MISSED_RUN_ENDS:
        if begin > len(rates):
            break
        run = slice(begin - 1, min(end, len(rates)))
        pair = _two_nodes(share[run], depth[run])
        weights += [pair[0], pair[2]]
        depths += [pair[1], pair[3]]
        least += [begin, begin + 1]
        steps = np.clip(np.arange(len(rates) + 1) - begin + 1, 1, end - begin + 1)
        lead += [0.5 - np.minimum(steps, 2) / (2.0 * steps)] * 2
        begin = end + 1
    return MissedSteps(np.stack(weights), np.stack(depths), least, np.stack(lead))


def _steps(
    rates: Float[np.ndarray, "steps kinds"], now: int
) -> tuple[Float[np.ndarray, "steps missed kinds"], Float[np.ndarray, "steps missed kinds"]]:
    """Weight and depth of the j-th missed step by steps missed in all; no weight beyond them."""
    count = len(rates)
    j = np.arange(1, count + 1)[:, None]
    missed = np.arange(count + 1)[None]
    number = now - missed + j
    is_missed = j <= missed
    number = np.where(is_missed, number, now)
    rate = rates[np.where(is_missed, count - missed + j - 1, 0)]
    share = np.where(is_missed, BETA1**j / (1.0 - BETA1**number), 0.0)[..., None] * rate
    depth = np.sqrt(BETA2**j / (1.0 - BETA2**number))[..., None]
    return share, depth.repeat(rates.shape[1], axis=-1)


def _two_nodes(
    share: Float[np.ndarray, "steps missed kinds"], depth: Float[np.ndarray, "steps missed kinds"]
) -> tuple[Float[np.ndarray, "missed kinds"], ...]:
    """Weight and depth of two nodes (Gauss' rule for a discrete measure), the earlier one first."""
    total = share.sum(axis=0)
    safe = np.where(total > 0, total, 1.0)
    mean = (share * depth).sum(axis=0) / safe
    offset = depth - mean
    spread = (share * offset**2).sum(axis=0) / safe
    is_pair = (share > 0).sum(axis=0) > 1
    middle = 0.5 * (share * offset**3).sum(axis=0) / np.where(is_pair, spread * safe, 1.0)
    reach = np.sqrt(middle**2 + np.where(is_pair, spread, 1.0))
    near, far = middle + reach, middle - reach
    first = np.where(is_pair, -total * far / (near - far), total)
    second = np.where(is_pair, total * near / (near - far), 0.0)
    return first, np.where(is_pair, mean + near, mean), second, np.where(is_pair, mean + far, 1.0)
