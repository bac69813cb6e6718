"""Boxes are judged where a LiDAR looked: those elsewhere say nothing, wrong ones there do."""

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch

from lidarpainter_models.checks.actors import check_box_points
from lidarpainter_models.checks.doctor import check_scene
from lidarpainter_models.checks.sweeps import LidarReach, check_coverage
from lidarpainter_models.geometry.boxes import is_inside_box
from lidarpainter_models.geometry.transforms import invert_rigid, transform_points
from lidarpainter_models.scenes.driving_scene import DrivingScene
from lidarpainter_models.synthetic import (
    RigCamera,
    SyntheticStreet,
    SyntheticStreetConfig,
    record_street,
)
from lidarpainter_models.synthetic.config import DEFAULT_CAMERAS

HALF_SECTOR_DEG = 60.0


@pytest.fixture(scope="module")
def street(tmp_path_factory):
    rear = RigCamera(name="rear_camera", focal_per_width=1.0, yaw_rad=math.pi)
    config = SyntheticStreetConfig(
        seed=7, num_frames=4, width_px=320, height_px=180, cameras=(DEFAULT_CAMERAS[0], rear)
    )
    return record_street(SyntheticStreet(config), tmp_path_factory.mktemp("street"))


def is_ahead(sweep, xyz_m):
    """What a LiDAR would have measured that looks ahead alone."""
    away_m = transform_points(invert_rigid(sweep.world_from_lidar).to(xyz_m), xyz_m)
    return torch.atan2(away_m[:, 1], away_m[:, 0]).rad2deg().abs() < HALF_SECTOR_DEG


def looking_ahead(path):
    """The street as recorded by a LiDAR of a sector, with labels all round."""
    scene = DrivingScene.open(path)
    whole = scene.read_column
    scene.read_column = lambda sweep, name: whole(sweep, name)[
        is_ahead(sweep, whole(sweep, "xyz_m"))
    ]
    scene.read_positions = cache(scene.read_positions)  # every track asks for them
    scene.tracks = tuple(recounted(scene, track) for track in scene.tracks)
    return scene


def recounted(scene, track):
    counts = []
    for frame_index, pose in zip(track.frame_indices.tolist(), track.world_from_box, strict=True):
        xyz_m = scene.read_positions(frame_index)
        counts.append(int(is_inside_box(xyz_m, pose, track.size_m).sum()))
    return replace(track, num_points=torch.tensor(counts))


def test_street_of_a_lidar_that_looks_ahead_passes(street):
    checks = {check.name: check for check in check_scene(looking_ahead(street))}
    assert [check for check in checks.values() if check.verdict == "fail"] == []
    boxes = checks["boxes hold points"]
    assert boxes.verdict == "ok", boxes
    assert "more left out: not in the sector" in boxes.detail
    images = checks["points in images"]
    assert images.verdict == "warn"
    assert images.detail.endswith("rear_camera looks where no LiDAR does")


def test_camera_that_sees_no_point_where_a_lidar_looks_fails(street):
    scene = looking_ahead(street)
    scene.views = tuple(
        replace(view, camera=replace(view.camera, cx_px=1e5))  # a lens that looks past its image
        if view.camera_name == "front_camera"
        else view
        for view in scene.views
    )
    verdict, detail = check_coverage(scene)
    assert verdict == "fail", detail
    assert detail.endswith("a camera sees no point")


def moved(scene, offset_m):
    """All boxes aside, with the points that they hold there."""
    tracks = []
    for track in scene.tracks:
        poses = track.world_from_box.clone()
        poses[:, :3, 3] += torch.tensor(offset_m, dtype=torch.float64)
        tracks.append(recounted(scene, replace(track, world_from_box=poses)))
    scene.tracks = tuple(tracks)
    return scene


def test_wrong_boxes_inside_the_sector_fail(street):
    verdict, detail = check_box_points(moved(looking_ahead(street), (0.0, 0.0, 3.0)))
    assert verdict == "fail", detail


def test_boxes_of_which_none_lies_where_a_lidar_looked_are_not_called_sound(street):
    verdict, detail = check_box_points(moved(looking_ahead(street), (0.0, 0.0, -25.0)))
    assert verdict == "warn"
    assert detail.startswith("none of ")
    assert "moving boxes within 40 m lies in the sector and range" in detail


@pytest.mark.parametrize(
    ("centre_m", "is_reached"),
    [
        ((10.0, 0.0, -1.0), True),
        ((10.0, -6.0, -1.0), True),
        ((-10.0, 0.0, -1.0), False),  # behind
        ((0.0, 10.0, -1.0), False),  # abeam
        ((35.0, 0.0, -1.0), False),  # beyond its range
        ((4.0, 0.0, -2.0), False),  # below its lowest beam
        ((4.0, 0.0, -1.8), True),  # but for its roof
        ((10.0, 0.0, 6.0), True),  # no actor flies
    ],
)
def test_reach_is_what_the_points_of_a_sweep_span(centre_m, is_reached):
    azimuth, elevation = np.meshgrid(
        np.radians(np.arange(-45, 45, 0.5)), np.radians([-15.0, -5.0, 2.0])
    )
    level = np.stack([np.cos(azimuth), np.sin(azimuth), np.tan(elevation)], axis=-1)
    rays = torch.from_numpy(20.0 * level.reshape(-1, 3)).float()
    turned = torch.tensor(
        [[0.0, -1, 0, 5], [1, 0, 0, 7], [0, 0, 1, 2], [0, 0, 0, 1]], dtype=torch.float64
    )  # the LiDAR stands anywhere and looks anywhere
    reach = LidarReach.of(transform_points(turned.float(), rays), turned)
    pose = turned.clone()
    pose[:3, 3] = transform_points(turned, torch.tensor([centre_m], dtype=torch.float64))[0]
    assert reach.could_hit(pose, torch.tensor([4.0, 2.0, 1.6])) is is_reached
