"""Adam (Kingma and Ba 2015) for the Gaussians that a step has seen, as if it had stepped all.

What is out of view has no gradient: its moments fade, and it still moves by what is left of them.
Rows are left as they are until they are wanted and then moved by all the steps they missed at
once. Centres move in units of their Gaussian's own size, the geometric mean of its two longer
deviations.
"""

from collections.abc import Callable

from jaxtyping import Int
from torch import Tensor

from lidarpainter_models.errors import ShapeError
from lidarpainter_models.kernels.backends import Backend, float32_backend, implementation
from lidarpainter_models.kernels.sparse_adam.state import (
    MOST_UNITS,
    AdamState,
    Parameters,
)

__all__ = [
    "MOST_UNITS",
    "AdamState",
    "Parameters",
    "catch_up",
    "present_rows",
    "step_rows",
]


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
    backend = float32_backend("sparse_adam", backend, kept.means)
    return implementation("sparse_adam", function, backend, kept.means.device)
