import torch
from gaussian_world import round_gaussians

from lidarpainter_models.gaussians.optimiser import (
    LEAST_COLOUR_GRADIENT,
    GaussianAdam,
    LearningRates,
    RowAdam,
)


def two_gaussians():
    gaussians = round_gaussians(torch.zeros(2, 3), torch.rand(2, 3), sigma_m=0.1)
    gaussians.log_scale[1] = torch.tensor([1.0, 1.0, 1.0]).log()
    return gaussians.as_leaves()


def test_centres_move_in_units_of_their_size():
    gaussians = two_gaussians()
    gaussians.means.grad = torch.ones(2, 3)
    GaussianAdam(gaussians, LearningRates(means=(0.1, 0.01))).step(gaussians, 0.0)
    assert torch.allclose(gaussians.means[0], torch.full((3,), -0.01), atol=1e-5)
    assert torch.allclose(gaussians.means[1], torch.full((3,), -0.1), atol=1e-5)


def test_parameters_without_gradient_stay():
    gaussians = two_gaussians()
    before = {name: value.clone() for name, value in gaussians.columns().items()}
    gaussians.sh_dc.grad = torch.ones(2, 1, 3)
    GaussianAdam(gaussians, LearningRates()).step(gaussians, 0.5)
    for name, value in gaussians.columns().items():
        assert torch.equal(value, before[name]) == (name != "sh_dc")
    assert gaussians.sh_dc.grad is None


def test_first_adam_step_has_the_length_of_the_rate():
    gaussians = two_gaussians()
    before = gaussians.opacity_logit.detach().clone()
    gaussians.opacity_logit.grad = torch.tensor([3.0, -7.0])
    GaussianAdam(gaussians, LearningRates(opacity_logit=(0.04, 0.01))).step(gaussians, 0.0)
    moved = gaussians.opacity_logit.detach() - before
    assert torch.allclose(moved, torch.tensor([-0.04, 0.04]), atol=1e-6)


def test_rates_fall_exponentially_from_first_to_last():
    rates = LearningRates(means=(0.16, 0.01))
    assert [round(rates.at("means", part), 6) for part in (0.0, 0.5, 1.0, 2.0)] == [
        0.16,
        0.04,
        0.01,
        0.01,
    ]


def test_moments_follow_their_rows():
    gaussians = two_gaussians()
    adam = GaussianAdam(gaussians, LearningRates())
    gaussians.means.grad = torch.tensor([[1.0] * 3, [2.0] * 3])
    adam.step(gaussians, 0.0)
    adam.rebuild(torch.tensor([1]), 3)
    assert adam.first["means"].shape == (4, 3)
    assert torch.allclose(adam.first["means"][0], torch.full((3,), 0.2))
    assert float(adam.first["means"][1:].abs().max()) == 0


def test_rows_without_gradient_do_not_drift():
    table = torch.zeros(3, 2).double()
    adam = RowAdam(table)
    rate = torch.tensor([0.1, 0.2]).double()
    gradient = torch.zeros(3, 2).double()
    gradient[1] = torch.tensor([4.0, -4.0])
    adam.step(table, gradient, rate)
    adam.step(table, torch.zeros(3, 2).double(), rate)
    assert torch.allclose(table[1], torch.tensor([-0.1, 0.2]).double())
    assert float(table[[0, 2]].abs().max()) == 0
    assert adam.count.tolist() == [0, 1, 0]


def test_colour_that_is_hardly_seen_moves_less_than_one_that_is():
    gaussians = two_gaussians()
    before = gaussians.sh_dc.detach().clone()
    gradient = torch.tensor([LEAST_COLOUR_GRADIENT / 10, LEAST_COLOUR_GRADIENT * 100])
    gaussians.sh_dc.grad = gradient[:, None, None].expand(-1, 1, 3).clone()
    GaussianAdam(gaussians, LearningRates(sh_dc=(0.01, 0.01))).step(gaussians, 0.0)
    moved = (before - gaussians.sh_dc.detach())[:, 0, 0]
    assert torch.allclose(moved, torch.tensor([0.01 / 11, 0.01 * 100 / 101]), rtol=1e-3)
