"""Cameras project, unproject and resize consistently."""

import pytest
import torch

from lidarpainter_models.errors import ConfigError
from lidarpainter_models.geometry.cameras import Camera, Shutter
from lidarpainter_models.geometry.transforms import rigid_from_tangent


def camera(**changes) -> Camera:
    settings = {
        "world_from_camera": torch.eye(4, dtype=torch.float64),
        "fx_px": 100.0,
        "fy_px": 110.0,
        "cx_px": 32.0,
        "cy_px": 24.0,
        "width_px": 64,
        "height_px": 48,
    }
    return Camera(**(settings | changes))


def test_point_on_the_axis_falls_on_the_principal_point():
    pixels, depth_m = camera().project(torch.tensor([[0.0, 0.0, 5.0]]))
    assert pixels.tolist() == [[32.0, 24.0]]
    assert depth_m.tolist() == [5.0]


def test_right_and_down_are_positive():
    pixels, _ = camera().project(torch.tensor([[1.0, 1.0, 10.0]]))
    assert pixels[0].tolist() == pytest.approx([42.0, 35.0])


def test_unprojected_pixels_project_back_to_their_centres():
    view = camera(
        world_from_camera=rigid_from_tangent(torch.tensor([0.1, 0.2, 0.3, 4, 5, 6.0]).double())
    )
    depth_m = torch.rand(48, 64, generator=torch.Generator().manual_seed(0)) * 20 + 1
    pixels, depth_again_m = view.project(view.unproject(depth_m).reshape(-1, 3))
    assert torch.allclose(depth_again_m, depth_m.reshape(-1), atol=1e-4)
    assert torch.allclose(pixels[0], torch.tensor([0.5, 0.5]), atol=1e-3)
    assert torch.allclose(pixels[-1], torch.tensor([63.5, 47.5]), atol=1e-3)


@pytest.mark.parametrize("across_s", [(0.0, 0.03), (-0.02, 0.0)])
def test_pixels_that_are_read_one_after_another_project_back_too(across_s):
    twist = torch.tensor([0.02, 0.1, -0.05, 0.5, 0.0, 15.0], dtype=torch.float64)
    view = camera(shutter=Shutter(across_s=across_s, twist_per_s=twist))
    depth_m = torch.rand(48, 64, generator=torch.Generator().manual_seed(0)) * 20 + 5
    pixels, depth_again_m = view.project(view.unproject(depth_m).reshape(-1, 3))
    assert torch.allclose(depth_again_m, depth_m.reshape(-1), atol=1e-3)
    assert torch.allclose(pixels[0], torch.tensor([0.5, 0.5]), atol=5e-3)
    assert torch.allclose(pixels[-1], torch.tensor([63.5, 47.5]), atol=5e-3)
    standing = camera().unproject(depth_m)
    assert float((view.unproject(depth_m) - standing).norm(dim=-1).max()) > 0.1


def test_resized_camera_sees_the_same_relative_position():
    points = torch.tensor([[0.7, -0.4, 6.0]])
    full, _ = camera().project(points)
    half, _ = camera().resized(width_px=32, height_px=24).project(points)
    assert torch.allclose(half * 2, full, atol=1e-5)


def test_points_behind_are_not_contained():
    view = camera()
    pixels, depth_m = view.project(torch.tensor([[0.0, 0.0, 5.0], [0.0, 0.0, -5.0]]))
    assert view.contains(pixels, depth_m).tolist() == [True, False]


@pytest.mark.parametrize("changes", [{"fx_px": 0.0}, {"width_px": 0}])
def test_impossible_lens_is_refused(changes):
    with pytest.raises(ConfigError, match="positive focal"):
        camera(**changes)


def test_nan_pose_is_refused():
    pose = torch.eye(4, dtype=torch.float64)
    pose[0, 0] = float("nan")
    with pytest.raises(ConfigError, match="rigid"):
        camera(world_from_camera=pose)
