import pytest
import torch
from gaussian_world import CAR_SIZE_M, round_gaussians

from lidarpainter_models.errors import ConfigError
from lidarpainter_models.gaussians.fitting.config import DensificationConfig
from lidarpainter_models.gaussians.fitting.densification import (
    GradientTally,
    densify,
    prune,
    split_along_longest_axis,
)


def ten(*, body=0):
    return round_gaussians(torch.randn(10, 3), torch.rand(10, 3), sigma_m=0.1, body=body)


def tally_of(*scores):
    tally = GradientTally.zeros(len(scores))
    tally.add(
        torch.arange(len(scores)), torch.tensor(scores), torch.ones(len(scores), dtype=torch.bool)
    )
    return tally


def test_the_most_wanted_are_split_up_to_the_target():
    gaussians = ten()
    tally = tally_of(*[float(score) for score in range(10)])
    change = densify(gaussians, tally, [], target=12)
    assert len(change.gaussians) == 12
    assert change.num_added == 4
    assert change.kept.tolist() == list(range(8))


def test_nothing_is_split_without_gradient():
    change = densify(ten(), GradientTally.zeros(10), [], target=12)
    assert len(change.gaussians) == 10
    assert change.num_added == 0


def test_gradients_count_only_where_visible():
    tally = GradientTally.zeros(2)
    tally.add(torch.tensor([0, 1]), torch.tensor([2.0, 3.0]), torch.tensor([True, False]))
    tally.add(torch.tensor([0, 1]), torch.tensor([4.0, 5.0]), torch.tensor([True, True]))
    assert tally.mean.tolist() == [3.0, 5.0]


def test_faint_and_broken_gaussians_are_dropped():
    gaussians = ten()
    gaussians.opacity_logit[0] = -9.0
    gaussians.means[1, 2] = torch.nan
    gaussians.log_scale[2, 0] = torch.inf
    assert prune(gaussians, []).kept.tolist() == [3, 4, 5, 6, 7, 8, 9]


def test_actor_gaussians_outside_their_box_are_dropped():
    gaussians = ten(body=1)
    gaussians.means[:] = 0.0
    gaussians.means[4, 0] = 2.0  # half the length is 1 m
    assert prune(gaussians, [CAR_SIZE_M]).kept.tolist() == [0, 1, 2, 3, 5, 6, 7, 8, 9]
    gaussians.body_index[:] = 0
    assert len(prune(gaussians, [CAR_SIZE_M]).gaussians) == 10


def test_halves_keep_the_mean_and_nearly_the_spread():
    parent = ten().select(torch.tensor([3]))
    parent.log_scale[0] = torch.tensor([0.1, 0.4, 0.2]).log()
    halves = split_along_longest_axis(parent)
    assert torch.allclose(halves.means.mean(0), parent.means[0], atol=1e-6)
    along = halves.means[:, 1] - parent.means[0, 1]
    variance = float(along.square().mean() + halves.scale_m[0, 1].square())
    assert abs(variance**0.5 - 0.4) < 0.01
    assert torch.allclose(halves.scale_m[:, [0, 2]], parent.scale_m[:, [0, 2]].expand(2, 2))


def test_schedule_that_runs_backwards_is_refused():
    with pytest.raises(ConfigError, match="start"):
        DensificationConfig(start=0.6, stop=0.5)
