"""Strips recover a camera's mount and exposure, then score what remains.

The world is a textured wall at x = 10 m; a renderer of that wall is exact, so whatever error is
left comes from calibration.
"""

import pytest
import torch

from lidarpainter_models.errors import DataError
from lidarpainter_models.evaluation.strips import (
    StripView,
    calibrate_strip,
    score_strips,
    strip_mask,
)
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.geometry.transforms import rigid_from_tangent

WALL_X_M = 10.0
TRUE_ROTATION_RAD = (0.004, -0.006, 0.003)


def wall_camera(lateral_m: float) -> Camera:
    world_from_camera = torch.eye(4, dtype=torch.float64)
    world_from_camera[:3, :3] = torch.tensor([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
    world_from_camera[1, 3] = lateral_m
    return Camera(
        world_from_camera=world_from_camera,
        fx_px=100.0,
        fy_px=100.0,
        cx_px=48.0,
        cy_px=32.0,
        width_px=96,
        height_px=64,
    )


def render_wall(camera: Camera, _timestamp_ns: int) -> torch.Tensor:
    rotation = camera.world_from_camera[:3, :3].float()
    directions = camera.pixel_directions() @ rotation.T
    travel = (WALL_X_M - float(camera.centre_world[0])) / directions[..., 0]
    y = float(camera.centre_world[1]) + travel * directions[..., 1]
    z = float(camera.centre_world[2]) + travel * directions[..., 2]
    waves = [
        torch.sin(3.1 * y + k) * torch.cos(2.7 * z - k) + 0.3 * torch.sin(y * z + k)
        for k in (0.0, 1.0, 2.0)
    ]
    return 0.5 + 0.25 * torch.stack(waves, dim=-1)


def wall_points() -> torch.Tensor:
    y, z = torch.meshgrid(torch.linspace(-6, 6, 160), torch.linspace(-4, 4, 110), indexing="ij")
    return torch.stack([torch.full_like(y, WALL_X_M), y, z], dim=-1).reshape(-1, 3)


def judged_view() -> StripView:
    """The judging camera's mount is turned and its image is darker than the log says."""
    turn = rigid_from_tangent(torch.tensor([*TRUE_ROTATION_RAD, 0, 0, 0], dtype=torch.float64))
    mounted = wall_camera(0.9)
    truth = render_wall(mounted.at(mounted.world_from_camera @ turn), 0) * 0.8 + 0.05
    return StripView(
        camera=mounted,
        timestamp_ns=0,
        truth_rgb=truth,
        fitted_camera=wall_camera(0.0),
        points_world=wall_points(),
    )


def test_mask_covers_only_what_both_cameras_see():
    mask = strip_mask(judged_view())
    assert mask[:, :80].float().mean() > 0.8
    far = StripView(**{**vars(judged_view()), "fitted_camera": wall_camera(40.0)})
    assert not strip_mask(far).any()


def test_rotation_and_exposure_are_recovered():
    view = judged_view()
    calibration = calibrate_strip(render_wall, [view])
    assert calibration.rotation_rad == pytest.approx(TRUE_ROTATION_RAD, abs=5e-4)
    # the judged image is box-averaged, its truth is not: contrast differs by a little
    assert calibration.affine[0][0] == pytest.approx(0.8, abs=0.03)
    scores = score_strips(render_wall, [view], calibration)
    assert scores.uncalibrated_psnr < 25 < 35 < scores.psnr


def test_cameras_that_share_nothing_are_refused():
    apart = StripView(**{**vars(judged_view()), "fitted_camera": wall_camera(60.0)})
    with pytest.raises(DataError, match="shares too few"):
        calibrate_strip(render_wall, [apart])
