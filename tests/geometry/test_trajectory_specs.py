"""Trajectories are read as they are written, and lead where they say."""

import math
import re

import pytest
import torch

from lidarpainter_models.errors import ConfigError
from lidarpainter_models.geometry.driven_paths import DrivenPath
from lidarpainter_models.geometry.shifts import Shift
from lidarpainter_models.geometry.trajectories import shift_pose
from lidarpainter_models.geometry.trajectory_parts import Moments
from lidarpainter_models.geometry.trajectory_specs import CAMERA_FROM_EGO, parse_trajectory
from lidarpainter_models.geometry.transforms import invert_rigid, rigid_from_tangent

COUNT, SPEED_MPS = 11, 10.0


def straight(speed_mps=SPEED_MPS, yaw_rad=0.0, start=(0.0, 0.0, 0.0)):
    """Eleven poses in ten seconds."""
    tangents = torch.zeros(COUNT, 6, dtype=torch.float64)
    tangents[:, 2] = yaw_rad
    way_m = speed_mps * torch.arange(COUNT)
    tangents[:, 3:] = torch.tensor(start)
    tangents[:, 3] += way_m * math.cos(yaw_rad)
    tangents[:, 4] += way_m * math.sin(yaw_rad)
    times_ns = torch.arange(COUNT) * 1_000_000_000
    return DrivenPath(timestamps_ns=times_ns, world_from_body=rigid_from_tangent(tangents))


MOMENTS = Moments(
    rows=torch.arange(COUNT),
    seconds=torch.arange(COUNT).double(),
    progress=torch.linspace(0, 1, COUNT, dtype=torch.float64),
    log_s=10.0,
)
CAR = straight(speed_mps=5.0, start=(30.0, 3.0, 0.8))


def car(name):
    assert name == "car"
    return CAR


def moved(spec, road=None, bodies=None, **options):
    road = road or straight()
    bodies = road.world_from_body if bodies is None else bodies
    trajectory = parse_trajectory(spec)
    return trajectory.placed(bodies, road, MOMENTS, car, **options)


def places(spec, road=None):
    return moved(spec, road)[:, :3, 3]


@pytest.mark.parametrize(
    ("spec", "expected"),
    [
        ("recorded", Shift()),
        ("lateral:2", Shift(lateral_m=2.0)),
        ("lateral:-3", Shift(lateral_m=-3.0)),
        ("up:1.5", Shift(up_m=1.5)),
        ("yaw:90", Shift(yaw_rad=math.pi / 2)),
        ("lateral:2 + up:1.5+lateral:1", Shift(lateral_m=3.0, up_m=1.5)),
    ],
)
def test_a_constant_shift_holds_everywhere(spec, expected):
    road = straight(yaw_rad=0.4)
    ego_from_camera = rigid_from_tangent(torch.tensor([0.1, 0.2, 0.3, 1.0, 2.0, 3.0]).double())
    cameras = road.world_from_body @ ego_from_camera
    found = moved(spec, road, cameras, is_camera=True)
    wanted = [shift_pose(camera, road.directions[0], expected) for camera in cameras]
    assert torch.allclose(found, torch.stack(wanted), atol=1e-12)


def test_a_lane_change_without_times_goes_on_from_first_to_last_and_keeps_the_heading():
    found = moved("lane-change")
    assert found[[0, 5, 10], 1, 3].tolist() == [0, 1.75, 3.5]
    assert torch.equal(found[:, :3, :3], straight().world_from_body[:, :3, :3])
    to_the_right = places("lane-change:-3+up:1")[-1]
    assert to_the_right.tolist() == [100.0, -3.0, 1.0]


def test_a_lane_change_with_times_turns_the_car_where_its_path_leads():
    found = moved("lane-change:3.5@2s+3s")
    assert found[[0, 2, 5, 10], 1, 3].tolist() == [0, 0, 3.5, 3.5]
    yaw = torch.atan2(found[:, 1, 0], found[:, 0, 0])
    assert yaw[[0, 1, 2, 5, 8]].tolist() == [0] * 5
    share = 0.5 / 1.5  # one of three seconds
    steepest = 3.5 * 30 * share**2 * (1 - share) ** 2 / 3
    assert float(yaw[3]) == pytest.approx(math.atan2(steepest, SPEED_MPS))


def test_who_stands_has_a_road_and_does_not_turn_across_it():
    road = straight(speed_mps=0.0, yaw_rad=math.pi / 2)
    found = moved("lane-change:2@1s+1s", road)
    assert found[-1, :3, 3].tolist() == pytest.approx([-2, 0, 0])
    assert torch.allclose(found[:, :3, :3], road.world_from_body[:, :3, :3])
    assert places("along:3", road)[4].tolist() == pytest.approx([0, 3, 0])


def test_along_goes_back_on_the_path_and_straight_out_of_its_ends():
    assert places("along:-5")[[0, 5], 0].tolist() == pytest.approx([-5, 45])
    with pytest.raises(ConfigError, match=r"9\.0 m out of the ends of the recorded path"):
        moved("along:9")


def test_along_turns_with_the_road():
    road = straight()
    poses = road.world_from_body.clone()
    poses[6:] = straight(yaw_rad=math.pi / 2, start=(50.0, -50.0, 0.0)).world_from_body[6:]
    curved = DrivenPath(timestamps_ns=road.timestamps_ns, world_from_body=poses)
    found = parse_trajectory("along:20", max_shift_m=None).placed(poses, curved, MOMENTS, car)
    assert found[4, :3, 3].tolist() == pytest.approx([50, 10, 0])
    assert found[4, 1, 0] == pytest.approx(1)


def test_following_rides_behind_at_ones_own_height():
    found = moved("follow:car+up:2")
    assert found[:, 0, 3].tolist() == pytest.approx((20 + 5.0 * torch.arange(COUNT)).tolist())
    assert found[:, 1, 3].tolist() == [3.0] * COUNT
    assert found[:, 2, 3].tolist() == [2.0] * COUNT


def test_an_orbit_looks_at_the_actor_all_the_way_round():
    cameras = straight().world_from_body @ invert_rigid(CAMERA_FROM_EGO)
    found = moved("orbit:car", bodies=cameras, is_camera=True)
    away = CAR.world_from_body[:, :3, 3] - found[:, :3, 3]
    looking = found[:, :3, 2]
    assert torch.allclose(torch.linalg.cross(away, looking), torch.zeros_like(away), atol=1e-9)
    assert ((away * looking).sum(1) > 8).all()
    assert (found[:, 2, 1] < -0.9).all()  # down in the image is down


def test_a_birds_eye_looks_down_with_the_road_upwards():
    cameras = straight().world_from_body @ invert_rigid(CAMERA_FROM_EGO)
    found = moved("birdseye:40+lateral:2", bodies=cameras, is_camera=True)[3]
    assert found[:3, 3].tolist() == [30.0, 2.0, 40.0]
    assert torch.allclose(found[:3, 2], torch.tensor([0.0, 0, -1]).double())
    assert torch.allclose(found[:3, 1], torch.tensor([-1.0, 0, 0]).double())


def test_waypoints_are_passed_in_time_and_give_the_heading(tmp_path):
    table = tmp_path / "a+up.csv"
    table.write_text("x_m, y_m\n0,0\n0,10\n0,20\n")
    found = moved(f"waypoints:{table}+up:1")
    assert found[5, :3, 3].tolist() == pytest.approx([0, 10, 1])
    assert found[5, :3, 0].tolist() == pytest.approx([0, 1, 0])
    table.write_text("time_s,x_m,y_m,z_m,yaw_deg\n2,0,0,1,90\n4,8,0,1,90\n")
    found = moved(f"waypoints:{table}")
    assert found[[0, 3, 10], 0, 3].tolist() == pytest.approx([0, 4, 8])
    assert found[3, :3, 0].tolist() == pytest.approx([0, 1, 0])


@pytest.mark.parametrize(
    ("content", "complaint"),
    [
        ("x_m\n1\n2\n", "columns x_m, expected x_m, y_m and if wanted time_s, z_m, yaw_deg"),
        ("x_m,y_m,speed\n1,2,3\n", "columns x_m, y_m, speed"),
        ("x_m,y_m\n1,2\n", "1 places, expected 2 to"),
        ("x_m,y_m\n1,2\n3,nan\n", "column y_m holds a value beyond"),
        ("x_m,y_m\n1,2\n3\n", "column y_m holds something else"),
        ("x_m,y_m\n1,2\n1e300,4\n", "column x_m holds a value beyond"),
        ("time_s,x_m,y_m\n1,2,3\n1,2,3\n", "time_s does not ascend"),
        ("\0", "cannot be read|columns"),
    ],
)
def test_a_table_that_says_no_path_is_refused(tmp_path, content, complaint):
    table = tmp_path / "places.csv"
    table.write_text(content)
    with pytest.raises(ConfigError, match=complaint):
        parse_trajectory(f"waypoints:{table}")


def test_names_can_be_folders():
    assert parse_trajectory("lateral:2+up:1.5").name == "lateral-2_up-1.5"


@pytest.mark.parametrize("spec", ["lateral:200", "up:-9", "lateral:5+lane-change:4"])
def test_a_path_farther_off_than_a_scene_can_show_is_refused(spec):
    with pytest.raises(ConfigError, match=f"'{re.escape(spec)}': .* at most 8 metres from the rec"):
        parse_trajectory(spec)
    assert parse_trajectory(spec, max_shift_m=None).steps


@pytest.mark.parametrize(
    "spec",
    [
        *("", "lateral", "lateral:", "up:x", "up:nan", "orbit", "a+b", "recorded:1", "follow:"),
        *("lateral:2+3s", "lane-change@2s", "lane-change:2@2s+0s", "lane-change:2@-1s+2s"),
        *("lateral:2@1s+2s", "birdseye:inf", "follow:a+orbit:b", "waypoints:nowhere.csv"),
    ],
)
def test_anything_else_is_refused(spec):
    with pytest.raises(ConfigError, match=r"trajectory|waypoints"):
        parse_trajectory(spec)
