"""A camera that looks a degree aside is found, on a street and on the real log; sound ones pass."""

import re
from dataclasses import replace

import numpy as np
import pytest
import torch

from lidarpainter_models.checks.calibration import (
    CameraTurn,
    best_turn,
    check_calibration,
    why_untold,
)
from lidarpainter_models.checks.depth_edges import SceneEdges
from lidarpainter_models.checks.doctor import check_licence
from lidarpainter_models.geometry.transforms import rigid_from_tangent
from lidarpainter_models.lidar.spatiotemporal_calibration import images_agree
from lidarpainter_models.readers import ingest_scene
from lidarpainter_models.scenes.driving_scene import DrivingScene
from lidarpainter_models.synthetic import SyntheticStreet, SyntheticStreetConfig, record_street

PITCH, YAW, ROLL = 0, 1, 2


@pytest.fixture(scope="module")
def street(tmp_path_factory):
    config = SyntheticStreetConfig(seed=7, num_frames=4, width_px=320, height_px=180)
    return record_street(SyntheticStreet(config), tmp_path_factory.mktemp("street"))


@pytest.fixture(scope="module")
def real_log(shared_folder, tmp_path_factory):
    store = tmp_path_factory.mktemp("real")
    return ingest_scene("pandaset", shared_folder / "data/pandaset", "002", store)


def turned(path, camera_name, axis, angle_deg):
    """The scene with one camera's stated rotation off about an axis of the camera."""
    scene = DrivingScene.open(path)
    tangent = torch.zeros(6, dtype=torch.float64)
    tangent[axis] = torch.deg2rad(torch.tensor(angle_deg))
    scene.views = tuple(
        replace(
            view, camera=view.camera.at(view.camera.world_from_camera @ rigid_from_tangent(tangent))
        )
        if view.camera_name == camera_name
        else view
        for view in scene.views
    )
    return scene


def checked(scene):
    """The check with what the images in motion say."""

    def agrees(name, turn):
        return images_agree(scene, name, -np.radians([turn.pitch_deg, turn.yaw_deg, turn.roll_deg]))

    return check_calibration(SceneEdges(scene), agrees)


def test_sound_cameras_of_a_street_pass_and_each_figure_says_whether_it_is_trusted(street):
    scene = DrivingScene.open(street)
    verdict, detail = check_calibration(SceneEdges(scene))
    assert verdict == "ok", detail
    figures = re.findall(r"(?:roll|pitch) [+-]\d\.\d\d (trusted|not trusted)", detail)
    assert len(figures) == 2 * len(scene.camera_names), detail


def test_roll_that_does_not_stand_out_is_said_to_be_not_trusted():
    turn = CameraTurn(yaw_deg=0.25, pitch_deg=0.0, peak=5.2, roll_deg=-2.25, roll_peak=2.13)
    assert not turn.is_wrong
    assert str(turn) == (
        "yaw +0.25 pitch +0.00 trusted, roll -2.25 not trusted (stands out by 2.13 of 3.5 "
        "deviations from other turns)"
    )


@pytest.mark.parametrize("axis", [PITCH, YAW, ROLL])
@pytest.mark.parametrize("angle_deg", [-1.0, 1.0])
def test_camera_of_a_street_turned_by_a_degree_is_found(street, axis, angle_deg):
    verdict, detail = checked(turned(street, "front_left_camera", axis, angle_deg))
    assert verdict != "ok", detail
    assert detail.startswith("front_left_camera turned")


@pytest.mark.parametrize(("agreed", "verdict"), [(True, "fail"), (None, "warn"), (False, "ok")])
def test_a_camera_fails_only_where_other_evidence_agrees(street, agreed, verdict):
    edges = SceneEdges(turned(street, "front_left_camera", YAW, 1.0))
    assert check_calibration(edges, lambda _name, _turn: agreed)[0] == verdict


def test_camera_turned_beyond_the_search_is_not_called_sound(street):
    verdict, detail = check_calibration(SceneEdges(turned(street, "front_camera", YAW, 8.0)))
    assert verdict != "ok", detail


def test_small_images_cannot_tell(small_scene):
    verdict, detail = check_calibration(SceneEdges(small_scene))
    assert verdict == "ok"
    assert "front_camera cannot be told (images of 0.7 pixels a degree" in detail


def test_narrow_cut_outs_cannot_tell(street):
    edges = SceneEdges(DrivingScene.open(street))
    for image in edges.images["front_camera"]:
        object.__setattr__(image, "camera", replace(image.camera, width_px=60))
    assert why_untold(edges, "front_camera") == "images 60 pixels across, 64 are needed"


@pytest.mark.slow
def test_sound_cameras_of_the_real_log_pass(real_log):
    verdict, detail = check_calibration(SceneEdges(DrivingScene.open(real_log)))
    assert verdict == "ok", detail


@pytest.mark.slow
@pytest.mark.parametrize("camera", ["front_camera", "left_camera", "right_camera", "back_camera"])
@pytest.mark.parametrize(
    ("axis", "angle_deg"), [(PITCH, 1.0), (YAW, -1.0), (YAW, 1.0), (ROLL, 1.0)]
)
def test_camera_of_the_real_log_turned_by_a_degree_is_found(real_log, camera, axis, angle_deg):
    verdict, detail = checked(turned(real_log, camera, axis, angle_deg))
    assert verdict != "ok", detail
    assert detail.startswith(f"{camera} turned")


@pytest.mark.slow
@pytest.mark.parametrize("camera", ["left_camera", "back_camera"])
def test_a_roll_is_not_taken_for_a_pitch(real_log, camera):
    """Before the roll is known these cameras look pitched by most of a degree."""
    edges = SceneEdges(turned(real_log, camera, ROLL, 1.0))
    turn = best_turn(edges.images[camera])
    assert turn.is_rolled
    assert turn.roll_deg == pytest.approx(1.0, abs=0.5)
    assert abs(turn.pitch_deg) <= 0.25


@pytest.mark.parametrize(
    ("licence", "verdict"),
    [("  ", "fail"), ("CC BY 4.0, somebody", "ok"), ("CC BY-NC-SA 4.0", "ok")],
)
def test_missing_licence_is_found(small_scene, licence, verdict):
    scene = DrivingScene.open(small_scene.path)
    scene.manifest["licence"] = licence
    found, detail = check_licence(scene)
    assert found == verdict
    assert ("no commercial use" in detail) == ("NC" in licence)
