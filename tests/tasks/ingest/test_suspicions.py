"""What is wrong about a recording is said by name, and of a sound one nothing is."""

import re
from dataclasses import replace

import pytest

from lidarpainter_models.scenes.driving_scene import DrivingScene
from lidarpainter_models.synthetic import SyntheticStreetConfig, write_street
from lidarpainter_models.synthetic.config import DEFAULT_CAMERAS
from tasks.ingest.data_checks import findings_about

STREET = SyntheticStreetConfig(
    seed=7, num_frames=16, width_px=480, height_px=270, speed_mps=(15.0, 15.0)
)
FRONT, *SIDES = DEFAULT_CAMERAS
SIDES_BY_NAME = [camera.name for camera in SIDES]
HALF_A_DEGREE = 0.5 / 57.29578


def with_front(**changes):
    return replace(STREET, cameras=(replace(FRONT, **changes), *SIDES))


FAULTS = {
    "50 ms": (with_front(delay_s=0.05), r"front_camera is (4|5)\d ms late"),
    "0.5 degrees": (
        with_front(yaw_error_rad=HALF_A_DEGREE),
        r"front_camera looks 0\.(4|5)\d degrees left of its calibration",
    ),
    "30 % brighter": (
        with_front(gain=1.3),
        r"front_left_camera is (2|3)\d% darker than front_camera",
    ),
    "boxes half a metre off": (
        replace(STREET, box_noise_m=0.4),
        r"boxes of standing cars lie 0\.[3-6]\d m off their points",
    ),
}
"""The street, and what must be said of it. 0.4 m each way are half a metre in the median."""


def said_of(scene):
    """What does not look sound, by name."""
    return {one.name: one.detail for one in findings_about(scene) if one.verdict != "ok"}


@pytest.fixture(scope="module")
def sound(tmp_path_factory):
    return DrivingScene.open(write_street(STREET, tmp_path_factory.mktemp("sound")))


@pytest.mark.slow
def test_nothing_is_said_of_a_sound_recording(sound):
    assert said_of(sound) == {}


@pytest.mark.slow
@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_is_said_by_name(fault, tmp_path):
    street, words = FAULTS[fault]
    said = said_of(DrivingScene.open(write_street(street, tmp_path)))
    assert any(re.search(words, detail) for detail in said.values()), said


@pytest.mark.slow
def test_images_of_two_cameras_that_changed_places_are_said(sound, monkeypatch):
    read, other = sound.read_image, dict(zip(SIDES_BY_NAME, reversed(SIDES_BY_NAME), strict=True))

    def swapped(view):
        name = other.get(view.camera_name, view.camera_name)
        (theirs,) = (v for v in sound.views_of(name) if v.frame_index == view.frame_index)
        return read(theirs)

    monkeypatch.setattr(sound, "read_image", swapped)
    said = said_of(sound)["cameras in their place"]
    assert said.startswith("the images of front_left_camera and front_right_camera")
