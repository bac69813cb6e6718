"""Cameras on another path: they ride on the car as they did when they were exposed."""

from dataclasses import replace

import pytest
import torch
from gaussian_world import FRAME_NS
from toy_street import ToyStreet

from lidarpainter_models.conditioning.moved_cameras import MovedCameras
from lidarpainter_models.geometry.trajectory_specs import parse_trajectory

SPEED_MPS = 10.0
NUM_FRAMES = 5
AHEAD_M = 1.5
"""Of the camera on the car."""


def drive(early_ns):
    """A car that drives along x; its camera is exposed so long before each frame."""
    street = ToyStreet(NUM_FRAMES)
    street.world_from_ego = torch.eye(4, dtype=torch.float64).repeat(NUM_FRAMES, 1, 1)
    street.world_from_ego[:, 0, 3] = SPEED_MPS * 0.1 * torch.arange(NUM_FRAMES)
    street.frame_timestamps_ns = torch.arange(NUM_FRAMES) * FRAME_NS
    views = []
    for view in street.views:
        time_ns = view.timestamp_ns - early_ns
        pose = view.camera.world_from_camera.clone()
        pose[0, 3] = AHEAD_M + SPEED_MPS * time_ns * 1e-9
        views.append(replace(view, timestamp_ns=time_ns, camera=view.camera.at(pose)))
    street.views = tuple(views)
    return street


@pytest.mark.parametrize("as_rig", [False, True])
@pytest.mark.parametrize("early_ns", [0, 40_000_000, 100_000_000, -30_000_000])
def test_a_camera_is_as_far_ahead_on_waypoints_as_on_the_car(tmp_path, early_ns, as_rig):
    file = tmp_path / "way.csv"
    file.write_text("time_s,x_m,y_m,yaw_deg\n-1,2,5,0\n9,202,5,0\n")  # at 20 m/s
    street = drive(early_ns)
    trajectory = parse_trajectory(f"waypoints:{file}")
    moving = MovedCameras(recorded=street, tracks=(), trajectory=trajectory, as_rig=as_rig)
    moved = moving.moved(street.views, [view.camera for view in street.views])
    seconds = torch.tensor([view.timestamp_ns * 1e-9 for view in street.views]).double()
    found = torch.stack([camera.world_from_camera[:3, 3] for camera in moved])
    expected_m = 2 + 20 * (seconds + 1) + AHEAD_M
    torch.testing.assert_close(found[:, 0], expected_m, rtol=0, atol=1e-5)
    torch.testing.assert_close(found[:, 1], torch.full_like(expected_m, 5.0), rtol=0, atol=1e-6)
