"""Drops in the air go, what stands in the street stays."""

import math

import pytest
import torch

from lidarpainter_models.scenes.lone_returns import WEATHER_REACH_M, is_confirmed, stands_alone

HEIGHT_M = 2.0


def turn_of(beams=64, columns=900):
    """A turn over level ground between two walls 12 m to either side: directions and ranges."""
    rise = torch.linspace(math.radians(-25), math.radians(8), beams)
    turn = torch.arange(columns) * (2 * math.pi / columns)
    rise, turn = (grid.reshape(-1) for grid in torch.meshgrid(rise, turn, indexing="ij"))
    directions = torch.stack([rise.cos() * turn.cos(), rise.cos() * turn.sin(), rise.sin()], dim=1)
    to_wall = 12.0 / directions[:, 1].abs().clamp(min=1e-3)
    to_ground = torch.where(directions[:, 2] < 0, -HEIGHT_M / directions[:, 2], torch.inf)
    return directions, torch.minimum(to_wall, to_ground).clamp(max=90.0)


@pytest.mark.parametrize("share", [0.01, 0.05, 0.2])
def test_drops_go_and_the_street_stays(share):
    directions, range_m = turn_of()
    generator = torch.Generator().manual_seed(0)
    stop_m = 12.0 * torch.rand(len(range_m), generator=generator)
    is_drop = torch.rand(len(range_m), generator=generator) < share
    is_drop &= stop_m < 0.9 * range_m
    kept = ~stands_alone(directions * torch.where(is_drop, stop_m, range_m)[:, None])
    assert kept[~is_drop].float().mean() > 0.995
    assert kept[is_drop].float().mean() < 0.07


@pytest.mark.parametrize(("beams", "columns"), [(1, 900), (4, 900), (64, 300)])
def test_few_beams_confirm_each_other(beams, columns):
    directions, range_m = turn_of(beams, columns)
    assert stands_alone(directions * range_m[:, None]).float().mean() < 0.03


def test_a_pole_stays_and_a_lone_return_goes_unless_it_is_far_away():
    directions, range_m = turn_of()
    is_pole = (directions[:, 1] / directions[:, 0]).abs().lt(0.004) & (directions[:, 0] > 0)
    pole_m = 8.0 / directions[:, 0].clamp(min=0.1)
    offset_m = directions * torch.where(is_pole, torch.minimum(pole_m, range_m), range_m)[:, None]
    assert not stands_alone(offset_m)[is_pole].any()
    sky = torch.tensor([[5.0, 0.0, 8.0], [0.0, 30.0, 40.0]])
    assert float(sky[1].norm()) > WEATHER_REACH_M
    assert stands_alone(torch.cat([offset_m, sky]))[-2:].tolist() == [True, False]


def test_a_turn_too_sparse_to_tell_keeps_all():
    directions, range_m = turn_of()
    few = torch.randperm(len(range_m), generator=torch.Generator().manual_seed(0))[:300]
    assert is_confirmed((directions * range_m[:, None])[few]).all()


def test_neighbours_are_found_across_the_ends_of_a_turn():
    directions, range_m = turn_of()
    behind = 8.0 * torch.tensor([[-1.0, -0.002, 0.4], [-1.0, 0.002, 0.4]])
    points = torch.cat([directions * range_m[:, None], behind])
    assert not stands_alone(points)[-2:].any()
    assert stands_alone(points[:-1])[-1]
    assert stands_alone(torch.zeros(0, 3)).shape == (0,)


@pytest.mark.parametrize(("share", "kept_share"), [(0.002, 1.0), (0.05, 0.95)])
def test_as_few_lone_returns_as_in_clear_air_stay(share, kept_share):
    directions, range_m = turn_of()
    chance, stop = torch.rand(2, len(range_m), generator=torch.Generator().manual_seed(0))
    is_drop = chance < share
    kept = is_confirmed(directions * torch.where(is_drop, 0.9 * stop * range_m, range_m)[:, None])
    assert kept.float().mean() == pytest.approx(kept_share, abs=0.01)
    assert kept.all() == (kept_share == 1)


@pytest.mark.parametrize(("beams", "columns"), [(32, 120), (16, 240), (16, 900)])
def test_a_lidar_of_wide_spacing_is_judged_by_its_own(beams, columns):
    directions, range_m = turn_of(beams, columns)
    assert stands_alone(directions * range_m[:, None]).float().mean() < 0.005


def test_a_road_thinned_to_one_spacing_in_metres_has_no_drops():
    x_m, y_m = torch.meshgrid(torch.arange(-10, 60, 0.5), torch.arange(-12, 12, 0.5), indexing="ij")
    road = torch.stack([x_m, y_m, torch.full_like(x_m, -HEIGHT_M)], dim=-1).reshape(-1, 3)
    assert is_confirmed(road + 0.1).all()
    drops = 20.0 * torch.rand(150, 3, generator=torch.Generator().manual_seed(0)) - 10.0
    drops[:, 2] = drops[:, 2].abs() + 0.5
    assert is_confirmed(torch.cat([road, drops]))[-150:].float().mean() < 0.1
