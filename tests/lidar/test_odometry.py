"""Sweeps alone tell where the car drove; loops of a drive that comes back are closed."""

import math
from itertools import pairwise

import numpy as np
import pytest
import torch
from tiny_street import swept_street

from lidarpainter_models.errors import SceneError
from lidarpainter_models.geometry.driven_paths import DrivenPath
from lidarpainter_models.geometry.transforms import invert_rigid, rigid_from_tangent
from lidarpainter_models.lidar.localised import write_localised, write_without_poses
from lidarpainter_models.lidar.loop_closure import with_loops_closed
from lidarpainter_models.lidar.odometry import drive_of, path_difference
from lidarpainter_models.lidar.sweep_registration import SweptFrame
from lidarpainter_models.scenes.driving_scene import DrivingScene, driven_road
from lidarpainter_models.scenes.schema import LOCALISED, POSES
from lidarpainter_models.synthetic import write_street

STREET = swept_street(seed=11, num_frames=8)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("street")


@pytest.fixture(scope="module")
def street(folder):
    return DrivingScene.open(write_street(STREET, folder))


@pytest.fixture(scope="module")
def stripped(street, folder):
    return DrivingScene.open(write_without_poses(street, folder, "stripped"))


def test_what_is_stripped_says_neither_poses_nor_boxes(street, stripped):
    assert not stripped.has_poses
    assert street.has_poses
    assert stripped.tracks == ()
    eye = torch.eye(4, dtype=torch.float64)
    torch.testing.assert_close(stripped.world_from_ego, eye.expand(STREET.num_frames, 4, 4))
    first, last = stripped.views[0].camera, stripped.views[-1].camera
    torch.testing.assert_close(first.world_from_camera, last.world_from_camera)


def test_true_poses_bring_back_everything_that_was_stripped(street, stripped, folder):
    path = driven_road(street)
    written = write_localised(stripped, path, folder, "back", provenance={})
    scene = DrivingScene.open(written)
    assert scene.manifest[POSES] == LOCALISED
    torch.testing.assert_close(scene.world_from_ego, street.world_from_ego)
    for was, now in zip(street.views, scene.views, strict=True):
        expected = was.camera.world_from_camera
        torch.testing.assert_close(now.camera.world_from_camera, expected, atol=1e-6, rtol=0)
        assert torch.equal(scene.read_image(now), street.read_image(was))
    was, now = (one.read_positions(3) for one in (street, scene))
    assert float((was - now).abs().max()) < 1e-3  # float32, and motion even by the millisecond


def test_sweeps_alone_tell_where_the_car_drove(street, stripped):
    found = drive_of(stripped)
    difference = path_difference(found, driven_road(street))
    assert difference.way_m > 3
    assert difference.translation_share < 0.006
    assert difference.turn_deg_per_10m < 0.15
    assert torch.equal(found.timestamps_ns, street.frame_timestamps_ns)
    torch.testing.assert_close(found.world_from_body[0], torch.eye(4, dtype=torch.float64))


def test_one_sweep_tells_nothing(street, monkeypatch):
    monkeypatch.setattr(street, "sweeps", street.sweeps[:1])
    with pytest.raises(SceneError, match="1 frames with LiDAR sweeps, expected two at least"):
        drive_of(street)


def straight(num_frames, *, turn_rad=0.0, stretch=1.0):
    """A metre a frame, straight ahead; a turn a frame bends it."""
    step = rigid_from_tangent(torch.tensor([0, 0, turn_rad, stretch, 0, 0]).double())
    poses = [torch.eye(4, dtype=torch.float64)]
    for _ in range(num_frames - 1):
        poses.append(poses[-1] @ step)
    times_ns = 100_000_000 * torch.arange(num_frames)
    return DrivenPath(timestamps_ns=times_ns, world_from_body=torch.stack(poses))


def test_paths_differ_by_what_their_motion_does():
    same = path_difference(straight(30), straight(30))
    assert same.way_m == pytest.approx(29)
    assert (same.translation_share, same.turn_deg_per_10m) == (0, pytest.approx(0, abs=1e-5))
    longer = path_difference(straight(30, stretch=1.01), straight(30))
    assert longer.translation_share == pytest.approx(0.01)
    bent = path_difference(straight(30, turn_rad=math.radians(0.1)), straight(30))
    assert bent.turn_deg_per_10m == pytest.approx(1.0, rel=1e-6)
    elsewhere = straight(30)
    away = rigid_from_tangent(torch.tensor([0, 0, 1.0, 5, 6, 7]).double())
    moved = DrivenPath(
        timestamps_ns=elsewhere.timestamps_ns, world_from_body=away @ elsewhere.world_from_body
    )
    assert path_difference(moved, straight(30)).translation_share == pytest.approx(0, abs=1e-9)
    assert path_difference(straight(30), straight(30, stretch=0.0)) is None


def yard():
    """Points of the walls and the ground of a yard of 60 by 40 m, and of a hut in it."""
    dice = np.random.default_rng(0)

    def wall(first, last, num):
        along = dice.uniform(size=(num, 1))
        points = np.array(first) + along * (np.array(last) - np.array(first))
        return np.column_stack([points, dice.uniform(0, 4, num)])

    corners = [(-10, -10), (50, -10), (50, 30), (-10, 30), (-10, -10)]
    walls = [wall(*ends, 3000) for ends in pairwise(corners)]
    hut = [(18, 8), (24, 8), (24, 12), (18, 12), (18, 8)]
    walls += [wall(*ends, 500) for ends in pairwise(hut)]
    ground = np.column_stack([dice.uniform(-10, 50, 7000), dice.uniform(-10, 30, 7000)])
    return np.concatenate([*walls, np.column_stack([ground, np.zeros(7000)])])


def lap(*, drift):
    """A round of 20 by 10 m and a little more, each step stretched and bent by a share."""
    step_m, poses = 2.0, [torch.eye(4, dtype=torch.float64)]
    turns = [math.pi / 2 if number % 15 in (9, 14) else 0.0 for number in range(33)]
    for turn in turns:
        tangent = [0, 0, turn + drift * 0.04, step_m * (1 + drift * 0.02), 0, 0]
        poses.append(poses[-1] @ rigid_from_tangent(torch.tensor(tangent).double()))
    times_ns = 100_000_000 * torch.arange(len(poses))
    return DrivenPath(timestamps_ns=times_ns, world_from_body=torch.stack(poses))


def seen_along(true, told):
    """What is seen from true poses, where it is taken to be by those that are told."""
    points = torch.from_numpy(yard())
    frames = []
    for number, (here, there) in enumerate(
        zip(true.world_from_body, told.world_from_body, strict=True)
    ):
        moved = there @ invert_rigid(here)
        own = (points @ moved[:3, :3].T + moved[:3, 3]).numpy()
        centre_m = there[:3, 3].numpy()
        frames.append(SweptFrame.of(own, centre_m, number))
    return frames


def test_a_drive_that_comes_back_is_closed():
    true, drifted = lap(drift=0.0), lap(drift=0.1)
    off_m = float((drifted.world_from_body[-1] - true.world_from_body[-1])[:3, 3].norm())
    assert off_m > 0.5
    closed = with_loops_closed(drifted, seen_along(true, drifted))
    left_m = float((closed.world_from_body[-1] - true.world_from_body[-1])[:3, 3].norm())
    assert left_m < 0.2 * off_m


def test_a_drive_that_never_comes_back_stays_as_it_is():
    path = straight(20)
    assert with_loops_closed(path, seen_along(path, path)) is path
