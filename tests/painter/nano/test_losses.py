"""Every term of the training loss, alone."""

from dataclasses import replace

import pytest
import torch

from lidarpainter_models.errors import ConfigError
from lidarpainter_models.painter.batches import stack_conditions
from lidarpainter_models.painter.nano.losses import (
    LossWeights,
    absolute_loss,
    agreement_mask,
    expected_error_loss,
    gradient_loss,
    painting_loss,
    squared_loss,
    structure_loss,
)
from lidarpainter_models.painter.nano.network import NanoOutput

TERMS = (absolute_loss, squared_loss, structure_loss, gradient_loss)


def pictures(seed=0):
    generator = torch.Generator().manual_seed(seed)
    return torch.rand(2, 3, 16, 20, generator=generator), torch.rand(
        2, 3, 16, 20, generator=generator
    )


def output_of(rgb, log_error=-3.0):
    return NanoOutput(
        rgb=rgb,
        base=rgb,
        log_error=torch.full_like(rgb[:, 0], log_error),
        weights=torch.ones_like(rgb[:, :1]),
    )


@pytest.mark.parametrize("term", TERMS)
def test_equal_pictures_cost_nothing(term):
    picture, _ = pictures()
    assert abs(float(term(picture, picture, torch.ones(2, 16, 20)))) < 1e-6


@pytest.mark.parametrize("term", TERMS)
def test_unknown_pixels_neither_cost_nor_pull(term):
    picture, target = pictures()
    picture.requires_grad_(True)
    mask = torch.ones(2, 16, 20)
    mask[:, :, 10:] = 0
    loss = term(picture, target, mask)
    loss.backward()
    assert float(loss.detach()) > 0
    assert float(picture.grad[..., 10:].abs().max()) == 0
    assert float(picture.grad[..., :10].abs().max()) > 0
    changed = picture.detach().clone()
    changed[..., 10:] = 0
    torch.testing.assert_close(term(changed, target, mask), loss.detach())


@pytest.mark.parametrize("term", TERMS)
def test_a_term_over_no_pixel_is_zero(term):
    picture, target = pictures()
    assert float(term(picture, target, torch.zeros(2, 16, 20))) == 0


def test_terms_match_hand_worked_answers():
    picture, target = torch.zeros(1, 3, 2, 2), torch.zeros(1, 3, 2, 2)
    picture[:, :, 0, 0] = 0.4
    mask = torch.ones(1, 2, 2)
    assert float(absolute_loss(picture, target, mask)) == pytest.approx(0.1)
    assert float(squared_loss(picture, target, mask)) == pytest.approx(0.04)
    # one of two horizontal and one of two vertical steps is off by 0.4
    assert float(gradient_loss(picture, target, mask)) == pytest.approx(0.4)


def test_expected_error_is_lowest_at_the_true_error():
    target = torch.full((1, 3, 8, 8), 0.5)
    mask = torch.ones(1, 8, 8)
    costs = {
        log_error: float(expected_error_loss(output_of(target + 0.1, log_error), target, mask))
        for log_error in (-4.0, -2.302585, -1.0)
    }
    assert min(costs, key=costs.get) == -2.302585


def test_expected_error_never_changes_the_picture():
    rgb = torch.full((1, 3, 8, 8), 0.7, requires_grad=True)
    log_error = torch.zeros(1, 8, 8, requires_grad=True)
    output = replace(output_of(rgb), log_error=log_error)
    expected_error_loss(output, torch.zeros(1, 3, 8, 8), torch.ones(1, 8, 8)).backward()
    assert rgb.grad is None
    assert log_error.grad is not None


def test_agreement_needs_every_valid_warp(make_conditions):
    conditions = make_conditions(4, 4, num_sources=2)
    render = conditions.render_rgb
    far = (render + 0.5) % 1
    valid = torch.zeros(2, 4, 4, dtype=torch.bool)
    valid[:, 0], valid[0, 1] = True, True
    warp = torch.stack([render, far])
    batch = stack_conditions([replace(conditions, warp_rgb=warp, warp_valid=valid)], num_sources=2)
    mask = agreement_mask(batch, 0.03)[0]
    assert float(mask[0].max()) == 0  # the second warp disagrees
    assert float(mask[1].min()) == 1  # only the first is valid, and agrees
    assert float(mask[2:].max()) == 0  # no warp at all


def test_total_is_the_weighted_sum_and_pulls_every_head(make_conditions):
    picture, target = pictures()
    rgb = picture.requires_grad_(True)
    log_error = torch.zeros(2, 16, 20, requires_grad=True)
    output = replace(output_of(rgb), log_error=log_error, base=target)
    batch = stack_conditions([make_conditions(16, 20, seed=s) for s in (0, 1)], num_sources=2)
    weights = LossWeights(absolute=1, squared=2, structure=3, gradient=4, expected_error=5, keep=6)
    terms = painting_loss(output, batch, target, torch.ones(2, 16, 20), weights)
    values = terms.to_dict()
    expected = sum(
        getattr(weights, name) * value for name, value in values.items() if name != "total"
    )
    assert values["total"] == pytest.approx(expected, rel=1e-5)
    terms.total.backward()
    assert float(rgb.grad.abs().max()) > 0
    assert float(log_error.grad.abs().max()) > 0


def test_negative_weights_are_refused():
    with pytest.raises(ConfigError, match="gradient"):
        LossWeights(gradient=-1)
