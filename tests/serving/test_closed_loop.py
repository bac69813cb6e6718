"""The bicycle by hand, and drives on a road whose every height and lane is known."""

import math

import numpy as np
import pytest
import torch
from made_road import (
    LENGTH_M,
    ORIGIN_M,
    SPEED_MPS,
    STEP_NS,
    height_m,
    moving_track,
    road_path,
    road_surroundings,
)

from lidarpainter_models.serving.closed_loop import CarState, ClosedLoop
from lidarpainter_models.serving.drive_film import film_image, shown_cameras
from lidarpainter_models.serving.policies import WHEELBASE_M, policy_named
from lidarpainter_models.serving.sensor_client import SeenFrame

START_NS = 10**15


class Renderer:
    """Stands for the cameras: notes what it is asked for."""

    def __init__(self):
        self.asked = []

    def __call__(self, world_from_rig, timestamp_us, actors):
        self.asked.append((world_from_rig, timestamp_us, dict(actors)))
        image = np.full((20, 40, 3), 90, np.uint8)
        confident = {"front": 0.95, "left": 0.4, "right": None}
        return {name: SeenFrame(rgb_u8=image, confidence=said) for name, said in confident.items()}


def loop_on(around, *, curvature_per_m=0.0, moving=(), lane_change_m=0.0):
    return ClosedLoop(
        surroundings=around,
        path=road_path(curvature_per_m),
        moving=moving,
        lane_change_m=lane_change_m,
    )


@pytest.fixture(scope="module")
def straight():
    return road_surroundings({-1.75: True, 1.75: False, 5.25: True})


def test_a_bicycle_turns_on_the_circle_of_its_steering():
    state = CarState(x_m=0.0, y_m=0.0, yaw_rad=0.0, speed_mps=5.0, steering_rad=0.3)
    radius_m = WHEELBASE_M / math.tan(0.3)
    for _ in range(200):
        state = state.after(0.0, 0.3, 0.1)
        away = math.hypot(state.x_m, state.y_m - radius_m)
        assert away == pytest.approx(radius_m, rel=1e-9)
    assert state.yaw_rad == pytest.approx(200 * 0.1 * 5.0 / radius_m)


def test_a_car_brakes_to_a_stop_and_no_further():
    state = CarState(x_m=0.0, y_m=0.0, yaw_rad=0.0, speed_mps=2.0)
    for _ in range(30):
        state = state.after(-4.0, 0.0, 0.1)
    assert state.speed_mps == pytest.approx(0.0, abs=1e-9)
    assert state.x_m == pytest.approx(0.5)


def test_steering_follows_as_fast_as_wheels_can_turn():
    state = CarState(x_m=0.0, y_m=0.0, yaw_rad=0.0, speed_mps=5.0).after(0.0, 1.0, 0.1)
    assert state.steering_rad == pytest.approx(0.08)


def test_the_log_policy_drives_as_recorded_and_the_rig_stands_as_it_did(straight):
    renderer = Renderer()
    loop = loop_on(straight)
    moments = list(loop.drive(policy_named("log"), renderer, start_ns=START_NS, seconds=4.0))
    assert len(moments) == 41
    recorded = road_path().world_from_body
    for (asked, time_us, _), pose in zip(renderer.asked, recorded, strict=False):
        assert (time_us * 1000 - START_NS) % STEP_NS == 0
        np.testing.assert_allclose(asked[:3, 3], pose[:3, 3], atol=0.12)
    first = renderer.asked[0][0]
    torch.testing.assert_close(first, recorded[0], atol=1e-6, rtol=0)
    last = renderer.asked[-1][0][:3, 3].numpy()
    assert last[2] == pytest.approx(height_m(last[0], last[1]) + ORIGIN_M, abs=0.04)


@pytest.mark.parametrize("curvature_per_m", [1 / 60, -1 / 60])
def test_the_lane_keeper_stays_on_a_bent_road(curvature_per_m):
    around = road_surroundings(curvature_per_m=curvature_per_m)
    loop = loop_on(around, curvature_per_m=curvature_per_m)
    driven = loop.drive(policy_named("lane-keep"), Renderer(), start_ns=START_NS, seconds=5.0)
    said = loop.judged(list(driven))
    assert said["off_road_s"] == said["off_ground_s"] == 0
    assert said["most_aside_m"] < 0.3
    assert said["way_m"] == pytest.approx(5.0 * SPEED_MPS, rel=0.05)
    assert said["collisions"] == []
    assert said["frames"] == 3 * 51
    assert (said["trusted_share"], said["least_confidence"]) == (0.5, 0.4)


def test_a_lane_change_ends_in_the_next_lane(straight):
    loop = loop_on(straight, lane_change_m=3.5)
    moments = list(loop.drive(policy_named("log"), Renderer(), start_ns=START_NS, seconds=4.5))
    assert moments[-1].state.y_m == pytest.approx(3.5, abs=0.25)
    assert not any(moment.is_off_road for moment in moments)


def test_who_leaves_the_lanes_is_off_the_road(straight):
    loop = loop_on(straight)
    driven = loop.drive(lambda _seen: (0.0, -0.2), Renderer(), start_ns=START_NS, seconds=2.0)
    assert loop.judged(list(driven))["off_road_s"] > 0.3


def test_who_drives_through_somebody_collides_and_idm_does_not(straight):
    times_ns = torch.arange(0, 60) * STEP_NS + START_NS
    stands = moving_track("slow", 22 + 0.02 * np.arange(60), 0.0, times_ns=times_ns)
    loop = loop_on(straight, moving=[stands])
    renderer = Renderer()
    driven = loop.drive(policy_named("log"), renderer, start_ns=START_NS, seconds=4.0)
    said = loop.judged(list(driven))
    assert said["nearest_actor_m"] == 0
    assert "slow" in [hit["obstacle"] for hit in said["collisions"]]
    assert set(renderer.asked[0][2]) == {"slow"}
    careful = loop.drive(policy_named("idm"), Renderer(), start_ns=START_NS, seconds=4.0)
    said = loop.judged(list(careful))
    assert "slow" not in [hit["obstacle"] for hit in said["collisions"]]
    assert 0.5 < said["nearest_actor_m"] < 6
    assert said["way_m"] < LENGTH_M / 2


def test_the_film_shows_three_cameras_from_left_to_right(straight):
    def looking(yaw_rad):
        pose = torch.eye(4, dtype=torch.float64)
        pose[0, 2], pose[1, 2] = math.cos(yaw_rad), math.sin(yaw_rad)
        return pose

    yaws = {"back": math.pi, "right": -1.0, "front": 0.0, "left": 1.0, "far_left": 1.6}
    names = shown_cameras({name: looking(yaw) for name, yaw in yaws.items()})
    assert names == ("left", "front", "right")
    loop = loop_on(straight)
    (moment, *_) = loop.drive(policy_named("log"), Renderer(), start_ns=START_NS, seconds=0.2)
    image = film_image(moment, names)
    assert image.shape[1] == 3 * 40
    bars = image[-7]  # in the middle of the bars
    left, front, right = (bars[40 * n + 2] for n in range(3))
    assert left[0] > left[1]  # red: not trusted
    assert front[1] > front[0]  # green
    torch.testing.assert_close(right[0], right[1])  # grey: nothing told
