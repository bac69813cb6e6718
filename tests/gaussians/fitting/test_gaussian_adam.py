"""The lazy Adam against a dense one: torch's, but for centres, which move in units of sizes."""

import numba
import pytest
import torch
from gaussian_world import round_gaussians

from lidarpainter_models.gaussians.fitting.learning_rates import LearningRates
from lidarpainter_models.gaussians.fitting.state import (
    COLOUR_PIXELS,
    LEAST_SHAPE_GRADIENT,
    GaussianAdam,
)
from lidarpainter_models.gaussians.model.gaussian_set import PARAMETERS, SH_CONSTANT, GaussianSet
from lidarpainter_models.gaussians.model.seen_gaussians import LEAVES

BETAS = (0.9, 0.99)
COLOURS = ("sh_dc", "sh_rest")
EPS = dict.fromkeys(PARAMETERS, LEAST_SHAPE_GRADIENT)
PIXELS = 160 * 90


def gradient_of_colour(filled_px):
    """Of a mean absolute difference, by a colour that fills so much of a pixel of an image."""
    colour = torch.ones(3, requires_grad=True)
    shown = torch.zeros(PIXELS, 3).index_add(
        0, torch.tensor([7]), filled_px * SH_CONSTANT * colour[None]
    )
    return float(torch.autograd.grad(shown.abs().mean(), colour)[0][0])


HALF_A_STEP = gradient_of_colour(COLOUR_PIXELS)
EPS |= dict.fromkeys(COLOURS, HALF_A_STEP)
RATES = LearningRates()


class DenseAdam:
    """Steps every row at every step."""

    def __init__(self, gaussians):
        self.gaussians = gaussians.as_leaves()
        kinds = self.gaussians.parameters()
        self.torch_adams = {
            name: torch.optim.Adam([value], betas=BETAS, eps=EPS[name], fused=True)
            for name, value in kinds.items()
            if name != "means"
        }
        self.first = torch.zeros_like(self.gaussians.means, dtype=torch.float64)
        self.second = torch.zeros_like(self.first)
        self.count = 0

    def step(self, gradients, fraction):
        self._step_means(gradients["means"].double(), RATES.at("means", fraction))
        for name, adam in self.torch_adams.items():
            adam.param_groups[0]["lr"] = RATES.at(name, fraction)
            getattr(self.gaussians, name).grad = gradients[name]
            adam.step()

    def _step_means(self, gradient, rate):
        ordered = self.gaussians.log_scale.detach().double().sort(dim=1).values
        sigma_m = (ordered[:, 1:].sum(dim=1, keepdim=True) / 2).exp()
        self.count += 1
        self.first = BETAS[0] * self.first + (1 - BETAS[0]) * gradient
        self.second = BETAS[1] * self.second + (1 - BETAS[1]) * gradient.square()
        first = self.first / (1 - BETAS[0] ** self.count)
        spread = (self.second / (1 - BETAS[1] ** self.count)).sqrt() + EPS["means"]
        with torch.no_grad():
            self.gaussians.means -= (rate * sigma_m * first / spread).float()


def some_gaussians(count, generator):
    spread = 0.5 * torch.randn(count, 3, generator=generator)
    gaussians = round_gaussians(
        torch.randn(count, 3, generator=generator),
        torch.rand(count, 3, generator=generator),
        sigma_m=0.1,
        sh_degree=2,
    )
    gaussians.log_scale += spread
    gaussians.sh_rest += 0.1 * torch.randn(gaussians.sh_rest.shape, generator=generator)
    return gaussians


def sparse_gradients(gaussians, is_seen, generator):
    """Of very different lengths, from far under the colours' epsilon to far above it."""
    size = 10.0 ** (8.0 * torch.rand(len(gaussians), generator=generator) - 10.0)
    gradients = {}
    for name, value in gaussians.parameters().items():
        noise = torch.randn(value.shape, generator=generator) + 0.5
        by_row = (size * is_seen).reshape(-1, *[1] * (value.ndim - 1))
        gradients[name] = noise * by_row
    return gradients


def lazy_step(adam, gaussians, rows, gradients, fraction):
    seen = adam.seen(gaussians, rows)
    both = torch.cat([gradients["sh_dc"], gradients["sh_rest"]], dim=1)
    for name in LEAVES:
        gradient = both if name == "sh" else gradients[name]
        getattr(seen, name).grad = gradient[rows].contiguous()
    adam.step(gaussians, seen, fraction)


def assert_as_dense(gaussians, dense, *, units):
    """Equal to a few dozen roundings of the dense one, and to a small part of one step's rate."""
    for name, value in gaussians.columns().items():
        if name == "body_index":
            continue
        truth = getattr(dense, name).detach()
        most = 3e-6 * truth.abs().clamp(min=0.1) + units * RATES.at(name, 0.0)
        assert bool(((value - truth).abs() <= most).all()), name


@pytest.mark.parametrize("share", [0.02, 0.1, 0.5, 1.0])
def test_rows_out_of_view_move_as_a_dense_adam_moves_them(share):
    generator = torch.Generator().manual_seed(int(100 * share))
    start = some_gaussians(300, generator)
    gaussians, dense = start.as_leaves(), DenseAdam(start)
    adam, steps = GaussianAdam(gaussians, RATES, PIXELS), 150
    for step in range(steps):
        is_seen = torch.rand(300, generator=generator) < share
        gradients = sparse_gradients(gaussians, is_seen, generator)
        # some rows that were looked at have no gradient all the same
        rows = (is_seen | (torch.rand(300, generator=generator) < 0.1)).nonzero()[:, 0]
        lazy_step(adam, gaussians, rows, gradients, step / steps)
        dense.step(gradients, step / steps)
    adam.catch_up(gaussians)
    assert_as_dense(gaussians, dense.gaussians, units=1e-4)


@pytest.mark.parametrize("missed", [1, 3, 8, 9, 13, 68, 261])
@pytest.mark.parametrize("before", [1, 5, 200])
def test_a_row_left_alone_is_where_its_momentum_takes_it(missed, before):
    generator = torch.Generator().manual_seed(missed)
    start = some_gaussians(60, generator)
    gaussians, dense = start.as_leaves(), DenseAdam(start)
    adam, steps = GaussianAdam(gaussians, RATES, PIXELS), before + missed
    everyone, nobody = torch.ones(60), torch.zeros(60)
    for step in range(steps):
        gradients = sparse_gradients(gaussians, everyone if step < before else nobody, generator)
        rows = torch.arange(60 if step < before else 0)
        lazy_step(adam, gaussians, rows, gradients, step / steps)
        dense.step(gradients, step / steps)
    looked_at = adam.seen(gaussians, torch.arange(60))
    adam.catch_up(gaussians)
    assert torch.equal(looked_at.means, gaussians.means)
    assert torch.equal(looked_at.sh[:, 1:], gaussians.sh_rest)
    assert_as_dense(gaussians, dense.gaussians, units=1e-4)


def test_threads_change_no_bit():
    if numba.config.NUMBA_NUM_THREADS < 2:
        pytest.skip("one core")
    before, fitted = numba.get_num_threads(), []
    try:
        for threads in (1, 2):
            numba.set_num_threads(threads)
            generator = torch.Generator().manual_seed(5)
            gaussians = some_gaussians(500, generator).as_leaves()
            adam = GaussianAdam(gaussians, RATES, PIXELS)
            for step in range(12):
                rows = (torch.rand(500, generator=generator) < 0.4).nonzero()[:, 0]
                gradients = sparse_gradients(gaussians, torch.ones(500), generator)
                lazy_step(adam, gaussians, rows, gradients, step / 12)
            adam.catch_up(gaussians)
            fitted.append(gaussians.columns())
    finally:
        numba.set_num_threads(before)
    assert all(torch.equal(value, fitted[1][name]) for name, value in fitted[0].items())


def test_looking_changes_nothing():
    generator = torch.Generator().manual_seed(0)
    gaussians = some_gaussians(20, generator).as_leaves()
    adam, everyone = GaussianAdam(gaussians, RATES, PIXELS), torch.arange(20)
    gradients = sparse_gradients(gaussians, torch.ones(20), generator)
    lazy_step(adam, gaussians, everyone, gradients, 0.0)
    for _ in range(5):
        lazy_step(adam, gaussians, everyone[:0], gradients, 0.1)
    kept = {name: value.clone() for name, value in adam.tensors().items()}
    before = {name: value.clone() for name, value in gaussians.columns().items()}
    adam.seen(gaussians, everyone)
    assert all(torch.equal(value, kept[name]) for name, value in adam.tensors().items())
    assert all(torch.equal(value, before[name]) for name, value in gaussians.columns().items())


def test_centres_move_in_units_of_their_size():
    gaussians = round_gaussians(torch.zeros(2, 3), torch.rand(2, 3), sigma_m=0.1)
    gaussians.log_scale[1] = 0.0
    gaussians = gaussians.as_leaves()
    adam = GaussianAdam(gaussians, LearningRates(means=(0.1, 0.01)), PIXELS)
    seen = adam.seen(gaussians, torch.arange(2))
    seen.means.grad = torch.ones(2, 3)
    adam.step(gaussians, seen, 0.0)
    assert torch.allclose(gaussians.means[0], torch.full((3,), -0.01), atol=1e-5)
    assert torch.allclose(gaussians.means[1], torch.full((3,), -0.1), atol=1e-5)


def test_parameters_without_gradient_stay():
    gaussians = some_gaussians(2, torch.Generator().manual_seed(2)).as_leaves()
    before = {name: value.clone() for name, value in gaussians.columns().items()}
    adam = GaussianAdam(gaussians, RATES, PIXELS)
    seen = adam.seen(gaussians, torch.arange(2))
    seen.sh.grad = torch.zeros_like(seen.sh)
    seen.sh.grad[:, 0] = 1.0
    adam.step(gaussians, seen, 0.5)
    adam.catch_up(gaussians)
    for name, value in gaussians.columns().items():
        assert torch.equal(value, before[name]) == (name != "sh_dc")


def test_colour_that_is_hardly_seen_moves_less_than_one_that_is():
    gaussians = some_gaussians(2, torch.Generator().manual_seed(3)).as_leaves()
    before = gaussians.sh_dc.detach().clone()
    adam = GaussianAdam(gaussians, LearningRates(sh_dc=(0.01, 0.01)), PIXELS)
    seen = adam.seen(gaussians, torch.arange(2))
    gradient = HALF_A_STEP * torch.tensor([0.1, 100.0])
    seen.sh.grad = torch.zeros_like(seen.sh)
    seen.sh.grad[:, 0] = gradient[:, None]
    adam.step(gaussians, seen, 0.0)
    moved = (before - gaussians.sh_dc.detach())[:, 0, 0]
    assert torch.allclose(moved, torch.tensor([0.01 / 11, 0.01 * 100 / 101]), rtol=1e-3)


def test_moments_follow_their_rows():
    gaussians = some_gaussians(2, torch.Generator().manual_seed(4)).as_leaves()
    adam = GaussianAdam(gaussians, RATES, PIXELS)
    seen = adam.seen(gaussians, torch.arange(2))
    seen.means.grad = torch.tensor([[1.0] * 3, [2.0] * 3])
    adam.step(gaussians, seen, 0.0)
    adam.catch_up(gaussians)
    adam.rebuild(torch.tensor([1]), 3)
    assert adam.state.first.shape[0] == 4
    assert torch.allclose(adam.state.first[0, :3], torch.full((3,), 0.2))
    assert float(adam.state.first[1:].abs().max()) == 0


def test_empty_set_takes_steps():
    gaussians = GaussianSet.empty().as_leaves()
    adam = GaussianAdam(gaussians, RATES, PIXELS)
    adam.step(gaussians, adam.seen(gaussians, torch.arange(0)), 0.0)
    adam.catch_up(gaussians)
    assert len(gaussians) == 0
