"""Adam (Kingma and Ba 2015) for the Gaussians that a step has seen, as if it had stepped all.

What is out of view has no gradient: its moments fade, and it still moves by what is left of them.
Rows are left as they are until they are wanted and then moved by all the steps they missed at
once. Centres move in units of their Gaussian's own size, the geometric mean of its two longer
deviations.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from lidarpainter_models.errors import ShapeError
from lidarpainter_models.kernels.backends import Backend, implementation
from lidarpainter_models.kernels.sparse_adam.device_rates import DeviceRates

BETA1, BETA2 = 0.9, 0.99
MOST_STEP = (1 - BETA1) / math.sqrt((1 - BETA2) * (1 - BETA1**2 / BETA2))
"""The largest step of Adam in learning rates: |m| <= 2.35 sqrt(v) by Cauchy and Schwarz."""
MOST_UNITS = MOST_STEP / (math.sqrt(BETA2) / BETA1 - 1)
"""The farthest that a row still moves without a gradient, in learning rates: the steps shrink by
BETA1 / sqrt(BETA2) each."""
MISSED_RUN_ENDS = (2, 4, 6, 8, 12, 20, 36, 68, 132, 260)
"""Last step of each run of missed steps that are taken at once; later ones are dropped."""
VECTOR = 8
"""Rows of moments are this many float32, half a cache line, or several times as long: no vector
loop ends in single numbers."""


class Parameters(NamedTuple):
    """Parameters of Gaussians (or their gradients), a row each, detached."""

    means: Tensor
    rotation_wxyz: Tensor
    log_scale: Tensor
    opacity_logit: Tensor
    """(rows)"""
    harmonics: Tensor
    """(rows, harmonics, 3): all of them or the constant ones."""
    more_harmonics: Tensor
    """(rows, harmonics, 3): those that `harmonics` lacks."""


@dataclass(eq=False, kw_only=True)
class AdamState:
    """Adam's moments of a set of Gaussians; a row of them has the columns of all parameters."""

    kind_of_column: Int[Tensor, " columns"]
    """Which of the learning rates a column has."""
    eps: Float[Tensor, " columns"]
    first: Float[Tensor, "rows columns"]
    second: Float[Tensor, "rows columns"]
    last: Int[Tensor, " rows"]
    """The step after which a row was left; its parameters and moments are those of then."""
    count: int = 0
    missed: list[list[float]] = field(default_factory=list)
    """Learning rates, one of each kind, of the steps since all rows were caught up; a backend may
    keep a copy of such a list, so it is only added to or replaced."""
    on_device: DeviceRates | None = None
    """The copy of the Triton backend."""

    @classmethod
    def empty(
        cls, rows: int, widths: list[int], eps: list[float], device: torch.device | None = None
    ) -> "AdamState":
        """Nothing moved yet; one width (columns) and one epsilon for each kind of parameter."""
        padded = [*widths[:-1], widths[-1] + -sum(widths) % VECTOR]
        kind_of_column = torch.repeat_interleave(torch.arange(len(widths)), torch.tensor(padded))
        return cls(
            kind_of_column=kind_of_column.to(device),
            eps=torch.tensor(eps)[kind_of_column].to(device),
            first=torch.zeros(rows, sum(padded), device=device),
            second=torch.zeros(rows, sum(padded), device=device),
            last=torch.zeros(rows, dtype=torch.int32, device=device),
        )


def present_rows(
    state: AdamState,
    kept: Parameters,
    rows: Int[Tensor, " seen"],
    out: Parameters,
    *,
    backend: Backend = "auto",
) -> None:
    """Write the given rows of the kept parameters, as the steps they missed left them, to `out`.

    Raises:
        ShapeError: the kept parameters or `out` have another number of rows.
    """
    _check(state, kept, rows, out)
    _chosen("present_rows", kept, backend)(state, kept, rows, out)


def step_rows(
    state: AdamState,
    kept: Parameters,
    rows: Int[Tensor, " seen"],
    seen: Parameters,
    gradients: Parameters,
    rates: list[float],
    *,
    backend: Backend = "auto",
) -> None:
    """The next step: move every given row whose gradient is not zero throughout, in place.

    `rows` are those that `seen` holds as `present_rows` gave them; `gradients` is what these
    collected; each kind of parameter has its rate.

    Raises:
        ShapeError: the parameters differ in their number of rows.
    """
    _check(state, kept, rows, seen)
    _check(state, kept, rows, gradients)
    state.count += 1
    state.missed.append(rates)
    _chosen("step_rows", kept, backend)(state, kept, rows, seen, gradients, rates)


def catch_up(state: AdamState, kept: Parameters, *, backend: Backend = "auto") -> None:
    """Bring every row and its moments up to the last step, in place.

    Raises:
        ShapeError: the parameters have another number of rows.
    """
    _check(state, kept)
    if state.missed:
        _chosen("catch_up", kept, backend)(state, kept)
    state.missed = []


def _check(
    state: AdamState, kept: Parameters, rows: Tensor | None = None, seen: Parameters | None = None
) -> None:
    if len(kept.means) != len(state.last):
        raise ShapeError(f"moments of {len(state.last)} rows, but {len(kept.means)} are kept")
    if rows is not None and seen is not None and len(seen.means) != len(rows):
        raise ShapeError(f"{len(rows)} rows are meant, but {len(seen.means)} are given")


def _chosen(function: str, kept: Parameters, backend: Backend) -> Callable[..., None]:
    means = kept.means
    return implementation("sparse_adam", function, backend, means.device, dtype=means.dtype)
