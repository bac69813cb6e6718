"""Damage done to Gaussians."""

import pytest
import torch

from lidarpainter_models.gaussians.model.gaussian_set import GaussianSet, sh_from_rgb
from lidarpainter_models.training_data import harvest_targets
from lidarpainter_models.training_data.harvest_targets import (
    corrupt_gaussians,
    drop_balls,
    fade_balls,
    grow_needles,
    is_bright_ground,
    is_flat,
    random_balls,
    recolour,
    shake_balls,
    tear_lane_paint,
    thin_balls,
)

HERE = torch.tensor([0.0, 0.0, 1.5])


def street(count=2000, seed=0):
    """A flat road with bright and dark plates, and ten Gaussians of an actor."""
    generator = torch.Generator().manual_seed(seed)
    means = 20 * torch.rand(count, 3, generator=generator) - 10
    means[:, 2] = 0
    luminance = torch.rand(count, 1, generator=generator)
    body = torch.zeros(count, dtype=torch.int32)
    body[:10] = 1
    rotation = torch.zeros(count, 4)
    rotation[:, 0] = 1
    return GaussianSet(
        means=means,
        rotation_wxyz=rotation,
        log_scale=torch.tensor([-2.0, -2.5, -5.0]).repeat(count, 1),
        opacity_logit=torch.ones(count),
        sh_dc=sh_from_rgb(luminance.expand(-1, 3)),
        sh_rest=torch.zeros(count, 3, 3),
        body_index=body,
    )


@pytest.mark.parametrize(
    ("damage", "columns"),
    [
        (fade_balls, {"opacity_logit"}),
        (thin_balls, {"log_scale"}),
        (shake_balls, {"means"}),
        (grow_needles, {"log_scale", "rotation_wxyz"}),
        (recolour, {"sh_dc"}),
        (tear_lane_paint, {"sh_dc"}),
    ],
)
def test_a_kind_of_damage_touches_its_columns_alone(damage, columns):
    before = street()
    kept = {name: value.clone() for name, value in before.columns().items()}
    after = damage(before, HERE, torch.Generator().manual_seed(1))
    for name, value in kept.items():
        assert torch.equal(getattr(before, name), value), "the input stays as it was"
        assert torch.equal(getattr(after, name), value) == (name not in columns), name
    for name in columns:
        rows = (getattr(after, name) != kept[name]).reshape(len(before), -1).any(dim=1)
        assert 0 < int(rows.sum()) < len(before)


def test_dropped_balls_leave_the_rest_as_it_was():
    before = street()
    after = drop_balls(before, HERE, torch.Generator().manual_seed(1))
    inside = random_balls(before, HERE, torch.Generator().manual_seed(1))
    assert 0 < len(after) < len(before)
    assert torch.equal(after.means, before.means[~inside])


def test_balls_lie_near_and_spare_actors(monkeypatch):
    monkeypatch.setattr(harvest_targets, "REACH_M", 5.0)
    monkeypatch.setattr(harvest_targets, "BALLS", (50, 50))
    gaussians = street()
    inside = random_balls(gaussians, HERE, torch.Generator().manual_seed(0))
    assert bool(inside.any())
    assert not bool(inside[gaussians.body_index > 0].any())
    distance_m = (gaussians.means - HERE).norm(dim=1)
    assert float(distance_m[inside].max()) < 5.0 * (1 + harvest_targets.RADIUS_SHARE[1])


def test_paint_is_bright_and_lies_flat():
    gaussians = street()
    gaussians.log_scale[10:20] = torch.tensor([-5.0, -2.0, -2.0])  # walls
    paint = is_bright_ground(gaussians)
    assert not bool(is_flat(gaussians)[:20].any())
    assert not bool(paint[:20].any())
    assert float(gaussians.base_rgb[paint].min()) > float(gaussians.base_rgb.median())


def test_damage_follows_from_the_seed():
    gaussians = street()
    first, again, other = (corrupt_gaussians(gaussians, HERE, seed=seed) for seed in (3, 3, 4))
    for name, value in first.columns().items():
        assert torch.equal(value, getattr(again, name))
    assert any(
        value.shape != getattr(other, name).shape or not torch.equal(value, getattr(other, name))
        for name, value in first.columns().items()
    )


def test_every_seed_gives_finite_gaussians():
    gaussians = street(500)
    for seed in range(20):
        after = corrupt_gaussians(gaussians, HERE, seed=seed)
        assert all(bool(value.isfinite().all()) for value in after.columns().values())


def test_nothing_stays_nothing():
    empty = street().select(torch.zeros(0, dtype=torch.int64))
    assert len(corrupt_gaussians(empty, HERE, seed=0)) == 0
