"""Which points of a map an image shows, and where."""

from dataclasses import replace

import torch
from gaussian_world import bare_points, camera_at

from lidarpainter_models.geometry.cameras import Shutter
from lidarpainter_models.lidar.points_in_view import NEAR_M, Body, PointsInView, points_in_view


def test_a_rolling_shutter_shows_the_points_that_it_reads_and_no_others():
    twist = torch.tensor([0.0, 0.0, 0.0, 0.0, 0.0, 15.0], dtype=torch.float64)
    shutter = Shutter(across_s=(0.0, 0.03), twist_per_s=twist)
    at_once = camera_at(0.0)
    camera = replace(at_once, shutter=shutter)
    xyz_m = torch.rand(2000, 3, generator=torch.Generator().manual_seed(0))
    xyz_m = at_once.centre_world.float() + (xyz_m - 0.5) * 8.0
    points = bare_points(xyz_m)
    pixels_uv, depth_m = camera.project(xyz_m.double())
    is_shown = camera.contains(pixels_uv, depth_m, near_m=NEAR_M)
    standing = at_once.contains(*at_once.project(xyz_m.double()), near_m=NEAR_M)
    assert bool((is_shown & ~standing).any())
    assert bool((standing & ~is_shown).any())
    found = PointsInView.joined(list(points_in_view([Body(None, points)], camera, 0, {})))
    assert torch.equal(found.rows, is_shown.nonzero()[:, 0])
    assert torch.allclose(found.pixels_uv.double(), pixels_uv[is_shown], atol=1e-3)
    assert torch.allclose(found.depth_m.double(), depth_m[is_shown], atol=1e-4)
