"""Rows that are stepped only when seen: compiled versions against every step taken, in double."""

from importlib import import_module

import pytest
import torch
from splat_drawing import TRITON, WITHOUT_TRITON, home_of

from lidarpainter_models.errors import BackendError, ShapeError
from lidarpainter_models.kernels.sparse_adam import (
    AdamState,
    Parameters,
    catch_up,
    present_rows,
    step_rows,
)
from lidarpainter_models.kernels.sparse_adam.reference import gathered_steps

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


@pytest.fixture(autouse=True)
def large_blocks(monkeypatch):
    """Triton's interpreter takes as long for many rows as for one; no row minds the others."""
    if WITHOUT_TRITON is None and home_of("triton").type == "cpu":
        backend = import_module("lidarpainter_models.kernels.sparse_adam.triton")
        monkeypatch.setattr(backend, "ROWS_AT_ONCE", 128)


def state_of(count, dtype, device):
    state = AdamState.empty(count, WIDTHS, LEAST, device)
    state.eps, state.first, state.second = (
        value.to(dtype) for value in (state.eps, state.first, state.second)
    )
    return state


class Run:
    """The same steps by one backend, where it works; what is shown comes back."""

    def __init__(self, start, backend, *, is_law=True):
        device = home_of(backend)
        start = in_double(start) if backend == "reference" and is_law else start
        self.kept = Parameters(*(value.to(device) for value in start))
        self.state = state_of(len(start.means), self.kept.means.dtype, device)
        self.backend, self.device = backend, device

    def shown(self, rows):
        rows = rows.to(self.device)
        out = Parameters(*(torch.zeros_like(value[rows]) for value in self.kept))
        present_rows(self.state, self.kept, rows, out, backend=self.backend)
        return out

    def step(self, rows, gradients, rates):
        rows, seen = rows.to(self.device), self.shown(rows)
        gradients = Parameters(*(value.to(self.kept.means) for value in gradients))
        step_rows(self.state, self.kept, rows, seen, gradients, rates, backend=self.backend)

    def finished(self):
        catch_up(self.state, self.kept, backend=self.backend)
        return self.kept


def assert_close(fast, truth, steps):
    """Each step rounds the value, and its move by a few roundings of the largest move."""
    for value, expected, rate in zip(fast, truth, RATES, strict=True):
        size_m = 40.0 if rate == RATES[0] else 1.0  # of the largest Gaussian in these worlds
        value, expected = value.cpu(), expected.cpu()
        most = EPS * steps * (expected.abs() + 16 * 2.4 * rate * size_m)
        # a run of missed steps stands for a few of them: 1e-4 of a single one
        most = most + 1e-4 * rate * size_m
        assert bool(((value.double() - expected).abs() <= most).all())


COMPILED = ["cpu", TRITON]
BACKENDS = ["cpu", "reference", TRITON]
LAGS = [(name, share, 40) for name in ("cpu", "reference") for share in (0.05, 0.3, 1.0)]
LAGS += [pytest.param("triton", 0.1, 16, marks=TRITON.marks)]
LAGS += [
    pytest.param("triton", share, 40, marks=[*TRITON.marks, pytest.mark.slow])
    for share in (0.05, 0.3, 1.0)
]


@pytest.mark.parametrize(("backend", "share", "steps"), LAGS)
def test_steps_in_float32_are_those_of_the_law(backend, share, steps):
    generator = torch.Generator().manual_seed(int(100 * share))
    start = random_parameters(120, generator)
    runs = [
        Run(Parameters(*(value.clone() for value in start)), name, is_law=is_law)
        for name, is_law in ((backend, False), ("reference", True))
    ]
    for step in range(steps):
        rows = (torch.rand(120, generator=generator) < share).nonzero()[:, 0]
        gradients = random_parameters(len(rows), generator)
        gradients.means[:3], gradients.more_harmonics[:3] = 0.0, 0.0
        rates = [rate * 0.95**step for rate in RATES]
        for run in runs:
            run.step(rows, gradients, rates)
    fast, plain = runs
    assert_close(fast.shown(torch.arange(0, 120, 3)), plain.shown(torch.arange(0, 120, 3)), steps)
    assert_close(fast.finished(), plain.finished(), steps)


@pytest.mark.parametrize("backend", COMPILED)
def test_a_row_without_gradient_is_left_as_one_that_missed_the_step(backend):
    generator = torch.Generator().manual_seed(0)
    run = Run(random_parameters(4, generator), backend)
    gradients = random_parameters(4, generator)
    for value in gradients:
        value[2] = 0.0
    run.step(torch.arange(4), gradients, RATES)
    assert run.state.last.tolist() == [1, 1, 0, 1]


@pytest.mark.parametrize("backend", BACKENDS)
def test_first_step_by_hand(backend):
    """Adam's first step is the rate, whatever the gradient; centres move in units of the size."""
    run = Run(Parameters(*(torch.zeros(2, *shape) for shape in SHAPES)), backend)
    gradients = Parameters(*(torch.full((2, *shape), 5.0) for shape in SHAPES))
    run.step(torch.arange(2), gradients, RATES)
    for value, rate in zip(run.kept, RATES, strict=True):
        assert torch.allclose(value.double(), torch.full_like(value, -rate).double(), rtol=1e-6)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("count", [0, 3])
def test_no_rows_take_steps(backend, count):
    run = Run(Parameters(*(torch.ones(count, *shape) for shape in SHAPES)), backend)
    run.step(torch.arange(0), Parameters(*(value[:0] for value in run.kept)), RATES)
    assert run.state.count == 1
    assert all(bool((value == 1.0).all()) for value in run.finished())
    assert run.state.missed == []


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_number_that_is_none_stays_in_its_column(backend):
    run = Run(Parameters(*(torch.zeros(3, *shape) for shape in SHAPES)), backend)
    gradients = Parameters(*(torch.ones(3, *shape) for shape in SHAPES))
    gradients.more_harmonics[1, 2, 0] = torch.nan
    for _ in range(2):
        run.step(torch.arange(3), gradients, RATES)
    lost = [value.isnan().nonzero().tolist() for value in run.finished()]
    assert lost == [[], [], [], [], [], [[1, 2, 0]]]


def test_what_does_not_belong_together_is_refused():
    run = Run(random_parameters(4, torch.Generator().manual_seed(1)), "cpu")
    with pytest.raises(ShapeError, match="moments of 4 rows"):
        catch_up(run.state, Parameters(*(value[:3] for value in run.kept)))
    with pytest.raises(ShapeError, match="2 rows are meant"):
        present_rows(run.state, run.kept, torch.arange(2), run.kept)


@pytest.mark.parametrize("backend", COMPILED)
def test_double_is_refused_by_compiled_code(backend):
    run = Run(random_parameters(4, torch.Generator().manual_seed(1)), backend)
    run.state.missed = [RATES]
    with pytest.raises(BackendError, match="takes float32"):
        catch_up(run.state, in_double(run.kept), backend=backend)


def triton_module(name="triton"):
    return import_module(f"lidarpainter_models.kernels.sparse_adam.{name}")


def bits_of(steps, *, count=21, change=lambda _state: None):
    """What a run by Triton ends with; something may change its state before every step."""
    generator = torch.Generator().manual_seed(2)
    run = Run(random_parameters(count, generator), "triton")
    for step in range(steps):
        rows = (torch.rand(count, generator=generator) < 0.4).nonzero()[:, 0]
        change(run.state)
        run.step(rows, random_parameters(len(rows), generator), [0.9**step * r for r in RATES])
    return [*run.finished(), run.state.first, run.state.second, run.state.last]


@pytest.mark.slow
@pytest.mark.parametrize("_backend", [TRITON])
def test_neither_blocks_nor_checkpoints_change_a_bit(_backend, monkeypatch):
    def taken_up(state):
        state.missed = [list(rates) for rates in state.missed]

    expected = bits_of(6)
    assert all(map(torch.equal, bits_of(6, change=taken_up), expected))
    monkeypatch.setattr(triton_module("device_rates"), "LEAST_ROOM", 2)
    monkeypatch.setattr(triton_module(), "ROWS_AT_ONCE", 8)
    assert all(map(torch.equal, bits_of(6), expected))


@pytest.mark.parametrize("_backend", [TRITON])
@pytest.mark.parametrize(("steps", "at_once"), [(1, 64), (70, 64), (300, 512)])
def test_nodes_made_on_the_device_are_those_of_the_host(_backend, steps, at_once, monkeypatch):
    backend = triton_module()
    monkeypatch.setattr(backend, "NUMBERS_AT_ONCE", at_once)
    state = AdamState.empty(3, WIDTHS, LEAST, home_of("triton"))
    state.missed = [[0.99**step * rate for rate in RATES] for step in range(steps)]
    for rates in state.missed[::3]:
        rates[4] = 0.0
    state.count = steps + 5
    expected = gathered_steps(state.missed, state.count)
    found = backend._with_nodes(state).nodes[:steps].cpu().double()
    found = found.permute(2, 1, 0, 3)  # numbers first
    places = slice(0, len(expected.weight), 2), slice(1, len(expected.weight), 2)
    for node, place in enumerate(places):
        weight, depth = (
            torch.from_numpy(table[place, 1:]) for table in (expected.weight, expected.depth)
        )
        runs = len(weight)
        assert torch.allclose(found[2 * node, :runs], weight, rtol=1e-5, atol=1e-10)
        counts = weight != 0
        assert torch.allclose(found[2 * node + 1, :runs][counts], depth[counts], rtol=1e-6)


@pytest.mark.parametrize("backend", ["reference", TRITON])
def test_parameters_need_not_lie_side_by_side_in_memory(backend):
    generator = torch.Generator().manual_seed(3)
    start, gradients = (random_parameters(5, generator) for _ in range(2))
    dense, strided = (Run(start, backend, is_law=False) for _ in range(2))
    dense.kept = Parameters(*(value.clone() for value in dense.kept))
    wide = (torch.stack([value, value], dim=-1) for value in strided.kept)
    strided.kept = Parameters(*(value[..., 0] for value in wide))
    for run in (dense, strided):
        run.step(torch.arange(5), gradients, RATES)
        run.step(torch.arange(2), Parameters(*(value[:2] for value in gradients)), RATES)
    assert all(map(torch.equal, dense.finished(), strided.finished()))
