"""Who moves is found from sweeps alone, with boxes where it is."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from tiny_street import swept_street

from lidarpainter_models.checks.seen_space import SeenSpace
from lidarpainter_models.errors import SceneError
from lidarpainter_models.lidar.mover_boxes import boxed, smoothed
from lidarpainter_models.lidar.mover_tracks import tracked
from lidarpainter_models.lidar.movers import box_of, find_movers, unboxed
from lidarpainter_models.lidar.moving_points import Clump
from lidarpainter_models.scenes.driving_scene import DrivingScene
from lidarpainter_models.synthetic import write_street

STREET = swept_street(seed=12, num_frames=12)
FRAME_NS = 100_000_000
CAR_M = np.array([4.2, 1.8, 1.5])


def test_beams_pass_what_is_nearer_than_where_they_end():
    azimuth = np.radians(np.arange(-20, 20, 0.1))
    wall_m = np.column_stack([20 * np.ones(len(azimuth)), 20 * np.tan(azimuth)])
    rows = [np.column_stack([wall_m, np.full(len(azimuth), z)]) for z in np.arange(-2, 2, 0.1)]
    space = SeenSpace(np.concatenate(rows), np.zeros(3))
    places = np.array([[10.0, 0, 0], [19.5, 0, 0], [25.0, 0, 0], [-10.0, 0, 0], [10.0, 0, 8]])
    passed = space.passed(places, beyond_m=1.0, beyond_share=0.0)
    # before the wall; too near it; behind it; where nothing is seen, twice
    assert passed.tolist() == [True, False, False, False, False]


def test_an_even_motion_is_smoothed_to_itself():
    times_s = np.arange(12) * 0.1
    seen_m = np.column_stack([3 + 8 * times_s, 1 - 2 * times_s])
    places_m, velocity = smoothed(times_s, seen_m, np.full(12, 0.2))
    np.testing.assert_allclose(places_m, seen_m, atol=0.03)
    np.testing.assert_allclose(velocity[3:-3], np.tile([8.0, -2.0], (6, 1)), atol=0.3)


def seen_car(centre_m, yaw_rad, eye_m, dice):
    """Points on the faces of a car that look towards an eye."""
    axes = np.array([[np.cos(yaw_rad), -np.sin(yaw_rad)], [np.sin(yaw_rad), np.cos(yaw_rad)]])
    eye = (eye_m - centre_m) @ axes
    points = []
    for axis in (0, 1):
        if abs(eye[axis]) > CAR_M[axis] / 2:
            face = dice.uniform(-0.5, 0.5, (150, 2)) * CAR_M[:2]
            face[:, axis] = np.sign(eye[axis]) * CAR_M[axis] / 2
            points.append(face)
    flat = np.concatenate(points) @ axes.T + centre_m
    return np.column_stack([flat, dice.uniform(0.3, CAR_M[2], len(flat))])


def clumps_of(path, yaw_rad=0.0, num_frames=12, seed=0):
    """A car along a path (of seconds), seen from the origin."""
    dice, clumps = np.random.default_rng(seed), []
    for number in range(num_frames):
        centre_m = np.array(path(0.1 * number))
        clumps.append(
            Clump(
                frame_index=number,
                time_ns=number * FRAME_NS,
                origin_m=np.array([0.0, 0.0, 1.8]),
                points_m=seen_car(centre_m, yaw_rad, np.zeros(2), dice),
                ground_m=0.0,
            )
        )
    return clumps


@pytest.mark.parametrize(
    ("path", "yaw_rad"),
    [
        (lambda t: (12 + 8 * t, 0.5), 0.0),  # ahead, its tail alone
        (lambda t: (14 + 9 * t, 5.0), 0.0),  # overtaking: tail and side
        (lambda t: (25 - 9 * t, 4.0), np.pi),  # oncoming: front and side
        (lambda t: (15.0, -12 + 8 * t), np.pi / 2),  # crossing
    ],
    ids=["ahead", "beside", "oncoming", "crossing"],
)
def test_a_box_stands_behind_the_faces_that_are_seen(path, yaw_rad):
    clumps = clumps_of(path, yaw_rad)
    mover = boxed(clumps)
    assert mover.category == "car"
    truth = np.array([path(0.1 * number) for number in range(12)])
    assert np.linalg.norm(mover.places_m - truth, axis=1).max() < 0.3
    x_axis = mover.world_from_box[6, :2, 0].numpy()
    assert x_axis @ [np.cos(yaw_rad), np.sin(yaw_rad)] > np.cos(np.radians(4))
    assert np.abs(mover.size_m - CAR_M).max() < 0.4
    bottom_m = mover.world_from_box[:, 2, 3].numpy() - mover.size_m[2] / 2
    np.testing.assert_allclose(bottom_m, 0, atol=0.02)


def test_what_stays_has_no_box():
    assert boxed(clumps_of(lambda _t: (12.0, 3.0))) is None
    assert boxed(clumps_of(lambda t: (12 + 8 * t, 3.0), num_frames=3)) is None


def test_a_lone_ring_and_what_hangs_in_the_air_are_nobody():
    clumps = clumps_of(lambda t: (12 + 8 * t, 3.0))
    flat = [replace(c, points_m=c.points_m * [1, 1, 0.05] + [0, 0, 0.7]) for c in clumps]
    high = [replace(c, ground_m=c.ground_m - 2.5) for c in clumps]
    assert boxed(clumps) is not None
    assert boxed(flat) is None
    assert boxed(high) is None


def test_tracks_that_cross_keep_apart():
    first = clumps_of(lambda t: (20 + 8 * t, 2.0), seed=1)
    second = clumps_of(lambda t: (30 - 8 * t, 5.5), np.pi, seed=2)
    frames = {number: list(both) for number, both in enumerate(zip(second, first, strict=True))}
    tracks = tracked(frames)
    assert sorted(len(track.clumps) for track in tracks) == [12, 12]
    for track in tracks:
        ways = {id(clump) for clump in track.clumps}
        assert ways in ({id(clump) for clump in first}, {id(clump) for clump in second})


def test_who_is_hidden_for_long_is_somebody_else():
    clumps = clumps_of(lambda t: (20 + 8 * t, 2.0), num_frames=24)
    frames = {clump.frame_index: [clump] for clump in clumps if not 5 <= clump.frame_index < 15}
    assert [len(track.clumps) for track in tracked(frames)] == [5, 9]


@pytest.fixture(scope="module")
def street(tmp_path_factory):
    return DrivingScene.open(write_street(STREET, tmp_path_factory.mktemp("street")))


def test_one_sweep_tells_of_nobody(street, monkeypatch):
    monkeypatch.setattr(street, "sweeps", street.sweeps[:1])
    with pytest.raises(SceneError, match="1 frames with LiDAR sweeps, expected two at least"):
        find_movers(street)


def test_cars_of_a_street_are_found_and_nothing_else(street):
    found = find_movers(street)
    moving = [track for track in street.tracks if track.is_moving]
    cars = [
        track
        for track in moving
        if track.category != "pedestrian" and int(track.num_points.min()) >= 60
    ]
    assert len(cars) >= 2
    for car in cars:
        own = box_of(car, [actor.track for actor in found])
        assert own is not None, car.actor_id
        apart_m = [
            float((own.pose_at(time_ns)[:2, 3] - pose[:2, 3]).norm())
            for time_ns, pose in zip(car.timestamps_ns.tolist(), car.world_from_box, strict=True)
            if own.is_present(time_ns)
        ]
        assert np.median(apart_m) < 0.5
    false = unboxed(found, moving)
    assert len(false) <= max(1, len(found) // 10)
    assert unboxed(found, [actor.track for actor in found]) == []
    assert all(0 <= actor.score <= 1 for actor in found)
    names = [actor.track.actor_id for actor in found]
    assert names[0] == "found-001"
    assert len(set(names)) == len(names)
    assert all(torch.isfinite(actor.track.world_from_box).all() for actor in found)
