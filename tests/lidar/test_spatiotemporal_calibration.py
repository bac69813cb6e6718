"""Faults of a recording, found from what LiDAR points look like in several images."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from toy_street import ToyStreet

from lidarpainter_models.geometry.cameras import Shutter
from lidarpainter_models.lidar.hub_images import contrasts_of
from lidarpainter_models.lidar.spatiotemporal_calibration import (
    Found,
    believed,
    cannot_be_told,
    find_faults,
)
from lidarpainter_models.scenes.driving_scene import DrivingScene
from lidarpainter_models.scenes.splits import split_views
from lidarpainter_models.synthetic import SyntheticStreetConfig, write_street
from lidarpainter_models.synthetic.config import DEFAULT_CAMERAS, RigLidar

FRONT, _, FRONT_RIGHT = DEFAULT_CAMERAS
SURE = np.full(5, 1e-6)


def faults_of(tmp_path, *cameras):
    street = SyntheticStreetConfig(
        seed=7,
        num_frames=20,
        width_px=320,
        height_px=180,
        speed_mps=(15.0, 15.0),
        cameras=cameras,
        lidar=RigLidar(columns=1200),
        is_readout_told=False,
    )
    scene = DrivingScene.open(write_street(street, tmp_path))
    return find_faults(scene, split_views(scene, "alternate").train)


def test_small_and_uncertain_departures_are_no_faults():
    large = np.array([0.0, 0.009, 0.0, 0.05, 0.0])
    assert believed(Found(0.1 * large, SURE)) is None
    assert believed(Found(large, large)) is None
    fault = believed(Found(large, SURE))
    assert (fault.turn_rad, fault.late_s, fault.readout_s) == ((0.0, 0.009, 0.0), 0.05, 0.0)


@pytest.mark.parametrize(
    ("num_frames", "speed_mps", "untold"),
    [(8, 10.0, []), (7, 10.0, ["front"]), (8, 1.0, ["front"]), (8, 9000.0, ["front"])],
    ids=["told", "few images", "stands", "times in microseconds"],
)
def test_what_cannot_be_told_is_named(num_frames, speed_mps, untold):
    driving = Shutter(twist_per_s=torch.tensor([0.0, 0.0, 0.0, 0.0, 0.0, speed_mps]))
    views = ToyStreet(num_frames=num_frames).views
    moved = [replace(v, camera=replace(v.camera, shutter=driving, fx_px=300.0)) for v in views]
    assert cannot_be_told(moved) == untold


def test_contrast_does_not_see_exposure():
    rgb = np.random.default_rng(0).integers(60, 120, (64, 64, 3)).astype(np.uint8)
    dark, bright = (contrasts_of(image)[3] for image in (rgb, 2 * rgb))
    assert np.allclose(dark, bright, atol=0.1)  # black is not quite black


@pytest.mark.slow
def test_each_sweep_is_read_once_for_all_cameras(monkeypatch):
    street = ToyStreet(num_frames=8, camera_gains=(("front", 1.0), ("beside", 0.8)))
    driving = Shutter(twist_per_s=torch.tensor([0.0, 0.0, 0.0, 0.0, 0.0, 10.0]))
    moved = [replace(v, camera=replace(v.camera, shutter=driving)) for v in street.views]
    read, read_column = [], street.read_column
    edges_agree = "lidarpainter_models.lidar.spatiotemporal_calibration._edges_agree"
    monkeypatch.setattr(edges_agree, lambda *_: True)  # a toy has no edges
    monkeypatch.setattr(
        street,
        "read_column",
        lambda sweep, name: read.append((sweep.frame_index, name)) or read_column(sweep, name),
    )
    find_faults(street, moved)
    columns = ("time_offset_ns", "xyz_m")
    assert sorted(read) == [(frame, name) for frame in street.frame_indices for name in columns]


@pytest.mark.slow
def test_clock_and_yaw_of_one_camera_are_found(tmp_path):
    yaw_rad = math.radians(0.5)
    wrong = replace(FRONT_RIGHT, delay_s=0.05, yaw_error_rad=yaw_rad)
    faults = faults_of(tmp_path, FRONT, wrong)
    assert list(faults) == [FRONT_RIGHT.name]
    fault = faults[FRONT_RIGHT.name]
    assert fault.late_s == pytest.approx(0.05, rel=0.2)
    assert fault.turn_rad[1] == pytest.approx(-yaw_rad, rel=0.2)  # y is down: to the left
