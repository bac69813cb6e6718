"""The small painter's own terms and its sum."""

from dataclasses import replace

import pytest
import torch

from lidarpainter_models.errors import ConfigError
from lidarpainter_models.painter.batches import stack_conditions
from lidarpainter_models.painter.losses import as_numbers
from lidarpainter_models.painter.nano.network import NanoOutput
from lidarpainter_models.painter.nano.training import (
    NanoLossWeights,
    expected_error_loss,
    harm_loss,
    painting_loss,
)


def images(seed=0):
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


def test_expected_error_is_lowest_at_the_true_error():
    target = torch.full((1, 3, 8, 8), 0.5)
    mask = torch.ones(1, 8, 8)
    costs = {
        log_error: float(expected_error_loss(output_of(target + 0.1, log_error), target, mask))
        for log_error in (-4.0, -2.302585, -1.0)
    }
    assert min(costs, key=costs.get) == -2.302585


def test_expected_error_never_changes_the_image():
    rgb = torch.full((1, 3, 8, 8), 0.7, requires_grad=True)
    log_error = torch.zeros(1, 8, 8, requires_grad=True)
    output = replace(output_of(rgb), log_error=log_error)
    expected_error_loss(output, torch.zeros(1, 3, 8, 8), torch.ones(1, 8, 8)).backward()
    assert rgb.grad is None
    assert log_error.grad is not None


def test_total_is_the_weighted_sum_and_pulls_every_head(make_conditions):
    image, target = images()
    rgb = image.requires_grad_(True)
    log_error = torch.zeros(2, 16, 20, requires_grad=True)
    output = replace(output_of(rgb), log_error=log_error, base=target)
    batch = stack_conditions([make_conditions(16, 20, seed=s) for s in (0, 1)], num_sources=2)
    weights = NanoLossWeights(
        absolute=1, squared=2, structure=3, gradient=4, expected_error=5, keep=6, harm=7
    )
    terms = painting_loss(output, batch, target, torch.ones(2, 16, 20), weights)
    values = as_numbers(terms)
    expected = sum(
        getattr(weights, name) * value for name, value in values.items() if name != "total"
    )
    assert values["total"] == pytest.approx(expected, rel=1e-5)
    terms["total"].backward()
    assert float(rgb.grad.abs().max()) > 0
    assert float(log_error.grad.abs().max()) > 0


def test_negative_weights_are_refused():
    with pytest.raises(ConfigError, match="gradient"):
        NanoLossWeights(gradient=-1)


def test_harm_counts_pixels_worse_than_all_before_and_no_others():
    target = torch.full((1, 3, 2, 2), 0.5)
    render, mean = target + 0.1, target + 0.2
    mean[..., 0, 0] = 0.5
    image = target.clone()
    image[..., 0, 0] += 0.1  # as the render, but the mean was right
    image[..., 0, 1] += 0.3  # worse than both
    image[..., 1, 0] += 0.3  # worse where nothing is known
    image[..., 1, 1] += 0.05  # better than both
    mask = torch.ones(1, 2, 2)
    mask[0, 1, 0] = 0
    expected = (0.01 + (0.09 - 0.01)) / 3
    assert float(harm_loss(image, [render, mean], target, mask)) == pytest.approx(expected)


def test_harm_is_measured_against_the_base_alone_where_the_render_is_not_shown(make_conditions):
    image, target = images()
    output = replace(output_of(image), base=target + 0.1)
    batch = stack_conditions([make_conditions(16, 20, seed=s) for s in (0, 1)], num_sources=2)
    known, weights = torch.ones(2, 16, 20), NanoLossWeights(harm=1)
    shown = painting_loss(output, batch, target, known, weights)["harm"]
    blind = painting_loss(output, batch, target, known, weights, sees_render=False)["harm"]
    both = [batch.render, target + 0.1]
    assert float(shown) == pytest.approx(float(harm_loss(image, both, target, known)))
    assert float(blind) == pytest.approx(float(harm_loss(image, both[1:], target, known)))
    assert float(shown) > float(blind)


def test_a_restyled_view_cannot_be_harmed(make_conditions):
    image, target = images()
    batch = stack_conditions([make_conditions(16, 20, seed=s) for s in (0, 1)], num_sources=2)
    known, restyled = torch.ones(2, 16, 20), torch.ones(2, dtype=torch.bool)
    terms = painting_loss(
        output_of(image), batch, target, known, NanoLossWeights(), restyled=restyled
    )
    assert float(terms["harm"]) == 0
