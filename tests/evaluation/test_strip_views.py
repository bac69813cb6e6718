"""Where the judging cameras stand, and when actors are where they look for them."""

from dataclasses import replace

import pytest
import torch
from gaussian_world import scene_trained_on
from toy_street import ToyStreet

from lidarpainter_models.evaluation.held_out import HeldOut
from lidarpainter_models.evaluation.strips import StripEvaluation, strip_views
from lidarpainter_models.geometry.cameras import Shutter
from lidarpainter_models.geometry.transforms import rigid_from_tangent
from lidarpainter_models.observations.settings import ObservationConfig
from lidarpainter_models.scenes.splits import split_views

SIDE = ("front", 1.0), ("side", 0.8)
MOTION = torch.tensor([0.0, 0.02, 0.01, 0.1, 0.0, 0.05], dtype=torch.float64)


@pytest.fixture
def street():
    return ToyStreet(num_frames=3, camera_gains=SIDE)


def with_shutter(street, **about):
    shutter = Shutter(twist_per_s=torch.tensor([0.0, 0.0, 0.0, 0.0, 0.0, 15.0]), **about)
    street.views = tuple(
        replace(view, camera=replace(view.camera, shutter=shutter)) for view in street.views
    )
    return street


def held_out(street):
    tests = tuple(view for view in street.views if view.frame_index == 1)
    return HeldOut(scene=street, test_views=tests, observation=ObservationConfig(width_px=240))


def fitted_to(street):
    """A scene whose training views are the front camera's, at frames 0 and 2."""
    views = [view for view in street.views if view.camera_name == "front" and view.frame_index != 1]
    return scene_trained_on(views)


def side_poses(street, fitted, frames):
    views = strip_views(
        held_out(street), fitted, judging_camera="side", fitted_camera="front", frames=frames
    )
    return [view.camera.world_from_camera for view in views]


def test_only_cameras_that_no_fit_saw_judge(street):
    views = split_views(street, "alternate", ("front",))
    assert StripEvaluation(held_out=held_out(street), views=views).cameras == ("side",)


def test_uncorrected_fit_leaves_the_judging_camera_where_the_log_says(street):
    poses = side_poses(street, fitted_to(street), (0, 1, 2))
    recorded = [view.camera.world_from_camera for view in street.views_of("side")]
    assert torch.allclose(torch.stack(poses), torch.stack(recorded), atol=1e-9)


def test_judging_camera_rides_on_the_rig_that_the_fit_moved(street):
    fitted = fitted_to(street)
    fitted.cameras.view_tangent[:] = MOTION  # frames 0 and 2, so frame 1 between them as well
    front, side = street.views_of("front")[1], street.views_of("side")[1]
    moved = front.camera.world_from_camera @ rigid_from_tangent(MOTION)
    world_motion = moved @ torch.linalg.inv(front.camera.world_from_camera)
    for pose in side_poses(street, fitted, (0, 1, 2)):
        assert torch.allclose(pose, world_motion @ side.camera.world_from_camera, atol=1e-6)


def test_judging_camera_reads_its_rows_as_its_image_was_read(street):
    rolling = with_shutter(street, across_s=(0.0, 0.03))
    (view,) = strip_views(
        held_out(rolling),
        fitted_to(rolling),
        judging_camera="side",
        fitted_camera="front",
        frames=(1,),
    )
    assert view.camera.shutter.across_s == (0.0, 0.03)


def test_actors_are_judged_where_a_late_image_shows_them(street):
    def columns(recorded):
        views = held_out(recorded).recorded_views(fitted_to(recorded), "interpolated")
        return (views[0].actor_index >= 0).nonzero()[:, 1].float()

    told = columns(street)
    late = columns(with_shutter(street, late_s=0.1))  # 1 m to the left, 10 m ahead: 16 pixels
    assert float((told.mean() - late.mean()).abs()) == pytest.approx(16, abs=3)
