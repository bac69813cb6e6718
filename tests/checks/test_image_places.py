"""Images that were turned over or mirrored are said to be, and sound ones are not."""

from dataclasses import replace

import pytest

from lidarpainter_models.checks.calibration import check_image_places
from lidarpainter_models.checks.depth_edges import SceneEdges
from lidarpainter_models.scenes.driving_scene import DrivingScene
from lidarpainter_models.synthetic import SyntheticStreetConfig, write_street
from lidarpainter_models.synthetic.config import DEFAULT_CAMERAS

STREET = SyntheticStreetConfig(
    seed=11, num_frames=8, width_px=240, height_px=135, cameras=DEFAULT_CAMERAS[:1]
)
OVER = {"turned upside down": (0, 1), "mirrored": (1,), "flipped": (0,)}


@pytest.fixture
def street(tmp_path):
    return DrivingScene.open(write_street(STREET, tmp_path))


def test_sound_images_stand_in_their_place(street):
    assert check_image_places(SceneEdges(street))[0] == "ok"


@pytest.mark.parametrize("way", OVER)
def test_images_turned_over_are_said(way, street, monkeypatch):
    read = street.read_image
    monkeypatch.setattr(street, "read_image", lambda view: read(view).flip(*OVER[way]))
    verdict, said = check_image_places(SceneEdges(street))
    assert verdict == "fail"
    assert f"{street.camera_names[0]}'s look {way}" in said


def test_images_too_coarse_to_tell_are_said_not_to_be_checked(tmp_path):
    coarse = replace(STREET, num_frames=4, width_px=96, height_px=54)
    street = DrivingScene.open(write_street(coarse, tmp_path))
    verdict, said = check_image_places(SceneEdges(street))
    assert verdict == "ok"
    assert "front_camera's are turned over was not checked (images of 1.7 pixels a degree" in said
