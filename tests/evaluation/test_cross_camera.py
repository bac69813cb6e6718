"""A camera left out of the fit judges it, on a street where the truth of every view is known.

The scene that is judged is the street itself: whatever error is left is the judging's own.
"""

import math
from dataclasses import replace

import pytest
import torch
from gaussian_world import scene_trained_on
from tiny_street import FRONT, NUM_FRAMES, SIDE, SIDE_GAIN, tiny_street

from lidarpainter_models.errors import DataError
from lidarpainter_models.evaluation.held_out import HeldOut
from lidarpainter_models.evaluation.strips import (
    StripEvaluation,
    calibrate_strip,
    score_strips,
    strip_mask,
    strip_views,
)
from lidarpainter_models.geometry.transforms import invert_rigid, rigid_from_tangent
from lidarpainter_models.observations.settings import ObservationConfig
from lidarpainter_models.scenes.driving_scene import DrivingScene
from lidarpainter_models.scenes.splits import split_views
from lidarpainter_models.synthetic import RigCamera, SyntheticStreet, record_street
from lidarpainter_models.synthetic.config import DEFAULT_CAMERAS

WIDTH_PX = 160
MOUNT_RAD = (0.012, -0.018, 0.009)
"""How far the mount of the side camera is off what the log says."""
FIT_FRAMES, JUDGED_FRAMES = (0, 2, 4), (1, 3, 5)


@pytest.fixture(scope="module")
def street():
    exact = {"sensor_noise": 0.0, "jpeg_quality": 100, "samples_per_axis": 2}
    return SyntheticStreet(tiny_street(width_px=WIDTH_PX, height_px=90, **exact))


@pytest.fixture(scope="module")
def scene(street, tmp_path_factory):
    return DrivingScene.open(record_street(street, tmp_path_factory.mktemp("street")))


@pytest.fixture(scope="module")
def views(scene):
    """What the side camera saw, by frame."""
    tests = tuple(view for view in scene.views if view.frame_index in JUDGED_FRAMES)
    held_out = HeldOut(
        scene=scene, test_views=tests, observation=ObservationConfig(width_px=WIDTH_PX)
    )
    fitted = scene_trained_on([view for view in scene.views_of(FRONT) if view not in tests])
    return strip_views(
        held_out, fitted, judging_camera=SIDE, fitted_camera=FRONT, frames=range(NUM_FRAMES)
    )


def test_the_true_scene_is_found_true_once_mount_and_exposure_are_known(street, views):
    def render(camera, timestamp_ns):
        return street.render(camera, timestamp_ns).rgb

    off = invert_rigid(rigid_from_tangent(torch.tensor([*MOUNT_RAD, 0, 0, 0]).double()))
    views = [
        replace(view, camera=view.camera.at(view.camera.world_from_camera @ off)) for view in views
    ]
    calibration = calibrate_strip(render, [views[frame] for frame in FIT_FRAMES])
    third_of_a_pixel_rad = 0.33 / views[0].camera.fx_px
    assert calibration.rotation_rad == pytest.approx(MOUNT_RAD, abs=third_of_a_pixel_rad)
    seen_grey = torch.tensor(calibration.affine) @ torch.tensor([0.4, 0.4, 0.4, 1.0])
    torch.testing.assert_close(seen_grey, torch.full((3,), SIDE_GAIN * 0.4), rtol=0, atol=0.02)
    scores = score_strips(render, [views[frame] for frame in JUDGED_FRAMES], calibration)
    assert scores.num_views == len(JUDGED_FRAMES)
    assert scores.uncalibrated_psnr < 18 < 26 < scores.psnr


def test_a_scene_that_is_wrong_is_found_wrong(street, views):
    """The side camera tells a street that stands half a metre aside from the true one."""
    aside = rigid_from_tangent(torch.tensor([0, 0, 0, 0.5, 0, 0]).double())

    def true(camera, timestamp_ns):
        return street.render(camera, timestamp_ns).rgb

    def shifted(camera, timestamp_ns):
        return true(camera.at(camera.world_from_camera @ aside), timestamp_ns)

    judged = [views[frame] for frame in JUDGED_FRAMES]
    fitted = [views[frame] for frame in FIT_FRAMES]
    psnr = {
        name: score_strips(render, judged, calibrate_strip(render, fitted)).psnr
        for name, render in (("true", true), ("shifted", shifted))
    }
    assert psnr["shifted"] < psnr["true"] - 3


def test_a_strip_is_what_both_cameras_see(street, views):
    view = views[0]
    mask = strip_mask(view)
    assert 0.1 < float(mask.float().mean()) < 0.5
    depth_m = street.render(view.camera, view.timestamp_ns).depth_m
    points_world = view.camera.unproject(depth_m)[mask & (depth_m > 0)]
    pixels_uv, other_m = view.fitted_camera.project(points_world.reshape(-1, 3))
    seen = view.fitted_camera.contains(pixels_uv, other_m)
    assert float(seen.float().mean()) > 0.9


def test_a_camera_judges_beside_the_fitted_one_that_sees_most_of_what_it_does(tmp_path):
    back = RigCamera(name="back_camera", focal_per_width=0.8, yaw_rad=math.pi)
    left = RigCamera(name="left_camera", focal_per_width=0.8, yaw_rad=1.0)
    right = RigCamera(name=SIDE, focal_per_width=0.8, yaw_rad=-0.35)
    rig = tiny_street(cameras=(back, left, DEFAULT_CAMERAS[0], right))
    scene = DrivingScene.open(record_street(SyntheticStreet(rig), tmp_path))
    seen = split_views(scene, "alternate", ("back_camera", "left_camera", FRONT))
    held_out = HeldOut(
        scene=scene, test_views=seen.test, observation=ObservationConfig(width_px=96)
    )
    evaluation = StripEvaluation(held_out=held_out, views=seen)
    assert evaluation.fitted_cameras == ("back_camera", "left_camera", FRONT)
    assert evaluation.neighbour(scene_trained_on(list(seen.train)), SIDE) == FRONT


def test_cameras_that_share_nothing_are_refused(views):
    elsewhere = views[0].fitted_camera.world_from_camera.clone()
    elsewhere[1, 3] += 500.0
    apart = replace(views[0], fitted_camera=views[0].fitted_camera.at(elsewhere))
    assert not strip_mask(apart).any()
    with pytest.raises(DataError, match="shares too few"):
        calibrate_strip(lambda *_place: views[0].truth_rgb, [apart])
