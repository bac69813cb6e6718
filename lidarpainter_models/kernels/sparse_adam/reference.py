"""Adam on rows in plain torch: every missed step is taken, one after the other. The law.

Any device and kind of numbers. At step t a row has m = BETA1 m + (1 - BETA1) g and
v = BETA2 v + (1 - BETA2) g^2 and moves by rate m / (1 - BETA1^t) over
sqrt(v / (1 - BETA2^t)) + eps; without a gradient, g is 0.
"""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from lidarpainter_models.kernels.sparse_adam.state import BETA1, BETA2, AdamState, Parameters

_MEANS, _LOG_SCALE = slice(0, 3), slice(7, 10)


def present_rows(
    state: AdamState, kept: Parameters, rows: Int[Tensor, " seen"], out: Parameters
) -> None:
    """See `sparse_adam.present_rows`."""
    values, _, _ = _caught_up(state, kept, rows)
    _store(values, out, torch.arange(len(rows), device=rows.device))


def step_rows(
    state: AdamState,
    kept: Parameters,
    rows: Int[Tensor, " seen"],
    seen: Parameters,
    gradients: Parameters,
    rates: list[float],
) -> None:
    """See `sparse_adam.step_rows`."""
    gradient = _table(state, gradients)
    is_moved = (gradient != 0).any(dim=1)
    rows, gradient, values = rows[is_moved], gradient[is_moved], _table(state, seen)[is_moved]
    faded = (state.count - 1 - state.last[rows])[:, None].to(values.dtype)
    first = BETA1**faded * state.first[rows]
    second = BETA2**faded * state.second[rows]
    first = BETA1 * first + (1 - BETA1) * gradient
    second = BETA2 * second + (1 - BETA2) * gradient.square()
    _store(values - _move(state, values, first, second, rates, state.count), kept, rows)
    state.first[rows], state.second[rows] = first, second
    state.last[rows] = state.count


def catch_up(state: AdamState, kept: Parameters) -> None:
    """See `sparse_adam.catch_up`."""
    rows = torch.arange(len(state.last), device=state.last.device)
    values, state.first[:], state.second[:] = _caught_up(state, kept, rows)
    _store(values, kept, rows)
    state.last[:] = state.count


def _caught_up(
    state: AdamState, kept: Parameters, rows: Int[Tensor, " seen"]
) -> tuple[
    Float[Tensor, "seen columns"], Float[Tensor, "seen columns"], Float[Tensor, "seen columns"]
]:
    """Parameters and moments of rows after the steps they missed."""
    values, last = _table(state, kept)[rows], state.last[rows]
    first, second = state.first[rows], state.second[rows]
    for place, rates in enumerate(state.missed):
        step = state.count - len(state.missed) + 1 + place
        missed: Bool[Tensor, "seen 1"] = (last < step)[:, None]
        first = torch.where(missed, BETA1 * first, first)
        second = torch.where(missed, BETA2 * second, second)
        move = _move(state, values, first, second, rates, step)
        values = torch.where(missed, values - move, values)
    return values, first, second


def _move(
    state: AdamState,
    values: Float[Tensor, "seen columns"],
    first: Float[Tensor, "seen columns"],
    second: Float[Tensor, "seen columns"],
    rates: list[float],
    step: int,
) -> Float[Tensor, "seen columns"]:
    """What a step takes off the values."""
    rate = torch.tensor(rates, dtype=torch.float64)[state.kind_of_column].to(values)
    spread = (second / (1 - BETA2**step)).sqrt() + state.eps.to(values)
    move = rate * (first / (1 - BETA1**step)) / spread
    size = values[:, _LOG_SCALE]
    size_m = (0.5 * (size.sum(dim=1) - size.amin(dim=1))).exp()
    move[:, _MEANS] *= size_m[:, None]
    return move


def _table(state: AdamState, parameters: Parameters) -> Float[Tensor, "rows columns"]:
    """All parameters side by side, with zeros where a row of moments is longer."""
    count = len(parameters.means)
    parts = [value.reshape(count, value[:1].numel() if count else 0) for value in parameters]
    table = torch.cat(parts, dim=1)
    return torch.nn.functional.pad(table, (0, state.first.shape[1] - table.shape[1]))


def _store(values: Float[Tensor, "seen columns"], out: Parameters, rows: Tensor) -> None:
    """Write a table's rows into rows of parameters."""
    begin = 0
    for value in out:
        width = value.shape[1:].numel()
        value[rows] = values[:, begin : begin + width].reshape(len(rows), *value.shape[1:])
        begin += width
