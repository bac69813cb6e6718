"""Rows that are stepped only when seen: the numba version against every step taken, in double."""

import pytest
import torch

from lidarpainter_models.errors import BackendError, ShapeError
from lidarpainter_models.kernels.sparse_adam import (
    AdamState,
    Parameters,
    catch_up,
    present_rows,
    step_rows,
)

EPS = torch.finfo(torch.float32).eps
WIDTHS = [3, 4, 3, 1, 3, 9]
LEAST = [1e-15] * 4 + [1e-7] * 2
RATES = [0.03, 2e-3, 1e-2, 3e-2, 6e-3, 6e-4]
SHAPES = ((3,), (4,), (3,), (), (1, 3), (3, 3))


def random_parameters(count, generator, size=1.0):
    values = [size * torch.randn(count, *shape, generator=generator) for shape in SHAPES]
    return Parameters(*values)


def in_double(parameters):
    return Parameters(*(value.double() for value in parameters))


def state_of(count, dtype):
    state = AdamState.empty(count, WIDTHS, LEAST)
    state.eps, state.first, state.second = (
        value.to(dtype) for value in (state.eps, state.first, state.second)
    )
    return state


class Run:
    """The same steps by one backend."""

    def __init__(self, start, backend, *, is_law=True):
        self.kept = in_double(start) if backend == "reference" and is_law else start
        self.state = state_of(len(start.means), self.kept.means.dtype)
        self.backend = backend

    def shown(self, rows):
        out = Parameters(*(torch.zeros_like(value[rows]) for value in self.kept))
        present_rows(self.state, self.kept, rows, out, backend=self.backend)
        return out

    def step(self, rows, gradients, rates):
        gradients = Parameters(*(value.to(self.kept.means.dtype) for value in gradients))
        step_rows(
            self.state, self.kept, rows, self.shown(rows), gradients, rates, backend=self.backend
        )

    def finished(self):
        catch_up(self.state, self.kept, backend=self.backend)
        return self.kept


def assert_close(fast, truth, steps):
    """Each step rounds the value, and its move by a few roundings of the largest move."""
    for value, expected, rate in zip(fast, truth, RATES, strict=True):
        size_m = 40.0 if rate == RATES[0] else 1.0  # of the largest Gaussian in these worlds
        most = EPS * steps * (expected.abs() + 16 * 2.4 * rate * size_m)
        # a run of missed steps stands for a few of them: 1e-4 of a single one
        most = most + 1e-4 * rate * size_m
        assert bool(((value.double() - expected).abs() <= most).all())


@pytest.mark.parametrize("backend", ["cpu", "reference"])
@pytest.mark.parametrize("share", [0.05, 0.3, 1.0])
def test_steps_in_float32_are_those_of_the_law(share, backend):
    generator = torch.Generator().manual_seed(int(100 * share))
    start = random_parameters(120, generator)
    runs = [
        Run(Parameters(*(value.clone() for value in start)), name, is_law=is_law)
        for name, is_law in ((backend, False), ("reference", True))
    ]
    for step in range(40):
        rows = (torch.rand(120, generator=generator) < share).nonzero()[:, 0]
        gradients = random_parameters(len(rows), generator)
        gradients.means[:3], gradients.more_harmonics[:3] = 0.0, 0.0
        rates = [rate * 0.95**step for rate in RATES]
        for run in runs:
            run.step(rows, gradients, rates)
    fast, plain = runs
    assert_close(fast.shown(torch.arange(0, 120, 3)), plain.shown(torch.arange(0, 120, 3)), 40)
    assert_close(fast.finished(), plain.finished(), 40)


def test_numba_leaves_a_row_without_gradient_as_one_that_missed_the_step():
    generator = torch.Generator().manual_seed(0)
    run = Run(random_parameters(4, generator), "cpu")
    gradients = random_parameters(4, generator)
    for value in gradients:
        value[2] = 0.0
    run.step(torch.arange(4), gradients, RATES)
    assert run.state.last.tolist() == [1, 1, 0, 1]


def test_first_step_by_hand():
    """Adam's first step is the rate, whatever the gradient; centres move in units of the size."""
    for backend in ("cpu", "reference"):
        run = Run(Parameters(*(torch.zeros(2, *shape) for shape in SHAPES)), backend)
        gradients = Parameters(*(torch.full((2, *shape), 5.0) for shape in SHAPES))
        run.step(torch.arange(2), gradients, RATES)
        for value, rate in zip(run.kept, RATES, strict=True):
            assert torch.allclose(value.double(), torch.full_like(value, -rate).double(), rtol=1e-6)


def test_no_rows_take_steps():
    for backend in ("cpu", "reference"):
        run = Run(Parameters(*(torch.zeros(0, *shape) for shape in SHAPES)), backend)
        run.step(torch.arange(0), run.kept, RATES)
        assert len(run.finished().means) == 0


def test_what_does_not_belong_together_is_refused():
    run = Run(random_parameters(4, torch.Generator().manual_seed(1)), "cpu")
    with pytest.raises(ShapeError, match="moments of 4 rows"):
        catch_up(run.state, Parameters(*(value[:3] for value in run.kept)))
    with pytest.raises(ShapeError, match="2 rows are meant"):
        present_rows(run.state, run.kept, torch.arange(2), run.kept)
    run.state.missed = [RATES]
    with pytest.raises(BackendError, match="float32"):
        catch_up(run.state, in_double(run.kept), backend="cpu")
