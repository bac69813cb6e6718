"""Trajectories are read as they are written."""

import math
import re

import pytest

from lidarpainter_models.errors import ConfigError
from lidarpainter_models.geometry.shifts import Shift
from lidarpainter_models.geometry.trajectory_specs import parse_trajectory


@pytest.mark.parametrize(
    ("spec", "expected"),
    [
        ("recorded", Shift()),
        ("lateral:2", Shift(lateral_m=2.0)),
        ("lateral:-3", Shift(lateral_m=-3.0)),
        ("up:1.5", Shift(up_m=1.5)),
        ("yaw:90", Shift(yaw_rad=math.pi / 2)),
        ("lateral:2+up:1.5+lateral:1", Shift(lateral_m=3.0, up_m=1.5)),
    ],
)
@pytest.mark.parametrize("progress", [0.0, 0.5, 1.0])
def test_a_constant_shift_holds_everywhere(spec, expected, progress):
    assert parse_trajectory(spec).shift_at(progress) == expected


def test_a_lane_change_starts_here_and_ends_a_lane_to_the_left():
    trajectory = parse_trajectory("lane-change")
    assert [trajectory.shift_at(progress).lateral_m for progress in (0, 0.5, 1)] == [0, 1.75, 3.5]
    to_the_right = parse_trajectory("lane-change:-3+up:1").shift_at(1.0)
    assert to_the_right == Shift(lateral_m=-3.0, up_m=1.0)


def test_names_can_be_folders():
    assert parse_trajectory("lateral:2+up:1.5").name == "lateral-2_up-1.5"


@pytest.mark.parametrize("spec", ["lateral:200", "up:-9", "lateral:5+lane-change:4"])
def test_a_path_farther_off_than_a_scene_can_show_is_refused(spec):
    with pytest.raises(ConfigError, match=f"'{re.escape(spec)}': .* at most 8 metres from the rec"):
        parse_trajectory(spec)


@pytest.mark.parametrize("spec", ["", "lateral", "lateral:", "up:x", "up:nan", "orbit", "a+b"])
def test_anything_else_is_refused(spec):
    with pytest.raises(ConfigError, match="trajectory"):
        parse_trajectory(spec)
