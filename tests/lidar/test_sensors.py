"""Sensors as data sheets have them, and files of sensors that somebody wrote."""

import json

import numpy as np
import pytest
import torch

from lidarpainter_models.errors import ConfigError
from lidarpainter_models.lidar.firings import fired_rays
from lidarpainter_models.lidar.sensors import (
    PRESETS,
    LidarSensor,
    preset_of,
    read_sensor,
    sensor_from_record,
)

BEAMS = {
    "hdl-32e": 32,
    "hdl-64e": 64,
    "vlp-16": 16,
    "pandar64": 64,
    "pandar128": 128,
    "at128": 128,
    "os1-128": 128,
}


def test_presets_have_the_beams_of_their_names():
    assert {name: sensor.num_beams for name, sensor in PRESETS.items()} == BEAMS
    assert PRESETS["pandar64"].steps == 1800
    for sensor in PRESETS.values():
        assert sorted(sensor.elevation_deg, reverse=True) == list(sensor.elevation_deg)


def test_a_turn_begins_behind_and_goes_to_the_right():
    sensor = LidarSensor(name="two", elevation_deg=(0.0, 30.0), steps=4)
    rays = fired_rays(sensor, torch.eye(4).double().expand(4, 4, 4), torch.tensor([3, 5, 7, 9]))
    first, second = rays.direction[0].tolist(), rays.direction[3].tolist()
    assert first == pytest.approx([-np.sqrt(0.5), np.sqrt(0.5), 0])  # behind, to the left
    assert second == pytest.approx([np.sqrt(0.375), np.sqrt(0.375), 0.5])
    assert rays.beam.tolist() == [0, 1] * 4
    assert rays.time_ns.tolist() == [3, 3, 5, 5, 7, 7, 9, 9]
    assert sensor.shares.tolist() == [0.125, 0.375, 0.625, 0.875]


def test_a_beam_may_look_aside_of_the_head():
    sensor = LidarSensor(name="aside", elevation_deg=(0.0,), azimuth_offset_deg=(90.0,), steps=1)
    ahead = sensor.directions(np.array([0]), np.array([0.0]))
    assert ahead[0] == pytest.approx([0, 1, 0], abs=1e-12)


def test_a_sensor_comes_back_from_its_file(tmp_path):
    path = tmp_path / "mine.json"
    path.write_text(json.dumps(PRESETS["at128"].to_record()), "utf-8")
    assert read_sensor(str(path)) == PRESETS["at128"]
    assert read_sensor("vlp-16") is PRESETS["vlp-16"]


def test_logs_name_their_sensors():
    assert preset_of("pandar64") is PRESETS["pandar64"]
    assert preset_of("HDL_64E") is PRESETS["hdl-64e"]
    assert preset_of("velodyne") is None


GOOD = {"name": "a", "elevation_deg": [0.0], "steps": 8}
NONSENSE = [
    ([], "expected an object with name, elevation_deg and steps"),
    ({"name": "a", "steps": 8}, "expected an object with name"),
    (GOOD | {"colour": 1}, "'colour' is no field of a sensor"),
    (GOOD | {"steps": 0}, "steps 0, expected 1 to 65536"),
    (GOOD | {"steps": 8.5}, "steps cannot be"),
    (GOOD | {"returns": 3}, "returns 3, expected 1 to 2"),
    (GOOD | {"returns": 1.5}, "returns cannot be"),
    (GOOD | {"steps": True}, "steps cannot be"),
    (GOOD | {"elevation_deg": []}, "0 beams"),
    (GOOD | {"elevation_deg": [91]}, "elevation_deg 91"),
    (GOOD | {"elevation_deg": [float("nan")]}, "elevation_deg cannot be"),
    (GOOD | {"elevation_deg": [0.0] * 5000}, "elevation_deg cannot be"),
    (GOOD | {"azimuth_offset_deg": [1, 2]}, "2 azimuth offsets for 1 beams"),
    (GOOD | {"azimuths_deg": [10.0, -10.0]}, "azimuths_deg -10, expected 10 to 180"),
    (GOOD | {"azimuths_deg": [10.0]}, "azimuths_deg cannot be"),
    (GOOD | {"max_range_m": 1e12}, "max_range_m cannot be"),
    (GOOD | {"min_range_m": 500.0}, "min_range_m 500"),
    (GOOD | {"turn_s": "fast"}, "turn_s cannot be 'fast'"),
    (GOOD | {"name": "x" * 100}, "name cannot be"),
]


@pytest.mark.parametrize(("record", "why"), NONSENSE)
def test_nonsense_is_refused_in_a_line(record, why):
    with pytest.raises(ConfigError, match=why) as refused:
        sensor_from_record(record, "mine.json")
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("content", ["", "{", '{"a":' * 9000, "[" * 100_000])
def test_a_file_that_is_no_json_is_refused(tmp_path, content):
    path = tmp_path / "broken.json"
    path.write_text(content, "utf-8")
    with pytest.raises(ConfigError, match="cannot be read as a sensor"):
        read_sensor(str(path))


@pytest.mark.parametrize("words", ["velodyne", "nowhere.json", ""])
def test_a_sensor_that_is_not_there_is_refused(words):
    with pytest.raises(ConfigError):
        read_sensor(words)
