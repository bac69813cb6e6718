"""Adam on the rows that a step saw, by Triton kernels: one launch a call, and the host never waits.

What stands for the missed steps is made on the device as well, by one more launch a step, from the
rates that the steps left there (`device_rates`). Every row is worked on alone.
"""

import math

import torch
import triton
from torch import Tensor

from lidarpainter_models.kernels.gpu_packages import dense_in_place
from lidarpainter_models.kernels.sparse_adam import (
    BETA1,
    BETA2,
    MISSED_RUN_ENDS,
    AdamState,
    Parameters,
)
from lidarpainter_models.kernels.sparse_adam import triton_kernels as kernels
from lidarpainter_models.kernels.sparse_adam.device_rates import DeviceRates

ROWS_AT_ONCE = 8
NUMBERS_AT_ONCE = 64
"""Missed steps that one program turns into nodes at once."""


def present_rows(state: AdamState, kept: Parameters, rows: Tensor, out: Parameters) -> None:
    """See `sparse_adam.present_rows`."""
    if len(rows) == 0:
        return
    with torch.cuda.device_of(rows), dense_in_place(out) as written:
        there = _with_nodes(state)
        kernels.present[_blocks(len(rows))](
            _contiguous(kept),
            tuple(written),
            state.first,
            state.second,
            state.last,
            rows.contiguous(),
            there.nodes,
            there.run_ends,
            state.kind_of_column,
            state.eps,
            len(rows),
            state.count,
            *_widths(kept),
            *_widths(out),
            *_columns(state),
            BLOCK=ROWS_AT_ONCE,
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
    if len(rows) == 0:
        return
    before = len(state.missed) - 1
    with torch.cuda.device_of(rows), dense_in_place(kept) as written:
        there = _rates(state)
        there.fill(before)
        kernels.step[_blocks(len(rows))](
            tuple(written),
            _contiguous(seen),
            _contiguous(gradients),
            tuple(rates),
            state.first,
            state.second,
            state.last,
            rows.contiguous(),
            there.rates,
            state.kind_of_column,
            state.eps,
            len(rows),
            state.count,
            before,
            1.0 / (1.0 - BETA1**state.count),
            math.sqrt(1.0 - BETA2**state.count),
            *_widths(kept),
            *_widths(seen),
            *_columns(state),
            BLOCK=ROWS_AT_ONCE,
        )
        there.filled = before + 1


def catch_up(state: AdamState, kept: Parameters) -> None:
    """See `sparse_adam.catch_up`."""
    if len(state.last) == 0:
        return
    with torch.cuda.device_of(state.last), dense_in_place(kept) as written:
        there = _with_nodes(state)
        kernels.catch_up_rows[_blocks(len(state.last))](
            tuple(written),
            state.first,
            state.second,
            state.last,
            there.nodes,
            there.run_ends,
            state.kind_of_column,
            state.eps,
            len(state.last),
            state.count,
            *_widths(kept),
            *_columns(state),
            BLOCK=ROWS_AT_ONCE,
        )


def _rates(state: AdamState) -> DeviceRates:
    """The copy of the missed steps' rates, with room for all; not all need be there yet."""
    there = state.on_device
    if there is None or len(state.missed) > len(there.rates):
        there = DeviceRates.empty(state.missed, MISSED_RUN_ENDS, state.first.device)
        state.on_device = there
    there.follow(state.missed)
    return there


def _with_nodes(state: AdamState) -> DeviceRates:
    """All rates of the missed steps and their nodes, which are made if a step was added."""
    there, count = _rates(state), len(state.missed)
    there.fill(count)
    if there.nodes_of != count:
        kernels.write_nodes[(triton.cdiv(count, NUMBERS_AT_ONCE), len(MISSED_RUN_ENDS))](
            there.rates, there.run_ends, there.nodes, count, state.count, BLOCK=NUMBERS_AT_ONCE
        )
        there.nodes_of = count
    return there


def _blocks(rows: int) -> tuple[int]:
    return (triton.cdiv(rows, ROWS_AT_ONCE),)


def _contiguous(parameters: Parameters) -> tuple[Tensor, ...]:
    return tuple(value.contiguous() for value in parameters)


def _widths(parameters: Parameters) -> tuple[int, int]:
    """Columns of the harmonics and of the further ones."""
    return 3 * parameters.harmonics.shape[1], 3 * parameters.more_harmonics.shape[1]


def _columns(state: AdamState) -> tuple[int, int]:
    """Columns of a row of moments and of a program."""
    columns = state.first.shape[1]
    return columns, triton.next_power_of_2(columns)
