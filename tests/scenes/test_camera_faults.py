"""What is wrong about a camera, in words and put right."""

import math
from dataclasses import replace

import pytest
import torch
from gaussian_world import camera_at

from lidarpainter_models.geometry.cameras import Shutter
from lidarpainter_models.scenes.camera_faults import CameraFault
from lidarpainter_models.scenes.shutters import twists_per_s

FORWARD = Shutter(twist_per_s=torch.tensor([0.0, 0, 0, 0, 0, 15.0], dtype=torch.float64))


def test_a_late_camera_stands_further_on():
    camera = replace(camera_at(1.0), shutter=FORWARD)
    corrected = CameraFault(late_s=0.05).corrected(camera)
    assert corrected.centre_world.tolist() == pytest.approx([1.75, 0.0, 1.0])
    assert corrected.taken_ns(1_000) == 1_000 + 50_000_000


def test_correcting_keeps_a_readout_that_is_told():
    told = replace(FORWARD, across_s=(0.0, 0.02))
    corrected = CameraFault(late_s=0.05).corrected(replace(camera_at(0.0), shutter=told))
    assert corrected.shutter.across_s == (0.0, 0.02)


def test_a_view_that_nobody_recorded_has_no_fault():
    camera = camera_at(0.0)
    assert CameraFault(late_s=0.05).corrected(camera) is camera


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        (CameraFault(late_s=0.012), "is 12 ms late"),
        (CameraFault(late_s=-0.012), "is 12 ms early"),
        (
            CameraFault(turn_rad=(0.0, -math.radians(0.5), 0.0)),
            "looks 0.50 degrees left of its calibration",
        ),
        (CameraFault(readout_s=0.03), "reads its rows down in 30 ms"),
    ],
)
def test_a_fault_is_said_in_words(fault, words):
    assert str(fault) == words


def test_twists_are_in_the_frame_of_the_camera():
    poses = torch.stack([camera_at(x).world_from_camera for x in (0.0, 1.0, 3.0)])
    twists = twists_per_s(torch.tensor([0, 100, 200]) * 1_000_000, poses)
    assert twists[:, 5].tolist() == pytest.approx([10.0, 15.0, 20.0])  # z looks ahead
    assert float(twists[:, :5].abs().max()) < 1e-9
    assert twists_per_s(torch.tensor([0]), poses[:1]).abs().max() == 0
