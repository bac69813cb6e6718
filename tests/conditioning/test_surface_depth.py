"""The depth that recorded images are carried by."""

import torch

from lidarpainter_models.conditioning.conditions import surface_depth

FOCAL_PX = 500.0


def render_and_lidar(*, wrong_by=1.02):
    """A wall at 10 m that the render puts 2 % too far; LiDAR hits every fourth column."""
    true_m = torch.full((24, 32), 10.0)
    lidar_m = torch.zeros_like(true_m)
    lidar_m[:, ::4] = true_m[:, ::4]
    return true_m, true_m * wrong_by, lidar_m


def test_lidar_stands_where_it_hit_and_corrects_the_render_around_it():
    true_m, render_m, lidar_m = render_and_lidar()
    found_m = surface_depth(render_m, lidar_m, FOCAL_PX)
    assert torch.equal(found_m[lidar_m > 0], lidar_m[lidar_m > 0])
    assert torch.allclose(found_m, true_m, rtol=1e-3)


def test_lidar_that_looked_past_an_edge_is_not_believed():
    _, render_m, lidar_m = render_and_lidar(wrong_by=0.5)
    assert torch.equal(surface_depth(render_m, lidar_m, FOCAL_PX), render_m)


def test_a_correction_reaches_no_further_than_its_neighbourhood():
    _, render_m, lidar_m = render_and_lidar()
    lidar_m[:, 4:] = 0
    found_m = surface_depth(render_m, lidar_m, FOCAL_PX)
    assert torch.equal(found_m[:, 20:], render_m[:, 20:])


def test_nothing_stays_nothing():
    nothing = torch.zeros(6, 8)
    assert torch.equal(surface_depth(nothing, nothing, FOCAL_PX), nothing)
    assert torch.equal(surface_depth(nothing, nothing + 5, FOCAL_PX), nothing)
