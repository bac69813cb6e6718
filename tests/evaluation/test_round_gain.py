"""What a painted round gained is told without a true image."""

from dataclasses import replace

import pytest
import torch
from gaussian_world import FRAME_NS, build_world, camera_at

from lidarpainter_models.conditioning.view_evidence import EvidenceGatherer
from lidarpainter_models.evaluation.round_gain import _halfway, round_gain
from lidarpainter_models.observations.views import GuidanceView


@pytest.fixture(scope="module")
def world():
    return build_world()


def painted(camera, timestamp_ns=FRAME_NS):
    grey = torch.full((camera.height_px, camera.width_px), 0.5)
    rgb = grey[..., None].expand(-1, -1, 3)
    return GuidanceView.of(camera, timestamp_ns, rgb=rgb, weight=grey, lidar_depth_m=grey)


def in_other_colours(scene):
    torch.manual_seed(0)
    gaussians = scene.gaussians
    other = gaussians.sh_dc + torch.randn_like(gaussians.sh_dc)
    return scene.with_gaussians(replace(gaussians, sh_dc=other))


def test_what_spoils_a_scene_lowers_it_and_what_mends_it_does_not(world):
    wrong = in_other_colours(world.scene)
    views = [painted(camera_at(0.4)), painted(camera_at(-0.4))]  # one of them is asked halfway
    lost = round_gain(world.scene, wrong, world.observations, views)
    won = round_gain(wrong, world.scene, world.observations, views)
    assert lost.after_db < lost.before_db - 1
    assert won.after_db > won.before_db + 1
    assert (lost.is_worse, won.is_worse) == (True, False)


def test_sharper_training_views_alone_are_no_gain(world, monkeypatch):
    measured = EvidenceGatherer.of
    closer = iter([20.0, 40.0])  # dB on training views, before and after
    monkeypatch.setattr(
        EvidenceGatherer, "of", lambda *words: replace(measured(*words), recorded_db=next(closer))
    )
    views = [painted(camera_at(0.4))]
    gain = round_gain(world.scene, world.scene, world.observations, views)
    assert gain.after_db == gain.before_db


def test_a_view_halfway_lies_between_the_painted_one_and_the_nearest_recorded_then(world):
    views = world.observations.views
    then = views[1].timestamp_ns
    aside = camera_at(5.0)
    nearest = min(
        (view.camera.centre_world for view in views if view.timestamp_ns == then),
        key=lambda centre: float((centre - aside.centre_world).norm()),
    )
    found = _halfway(painted(aside, then), views).centre_world
    torch.testing.assert_close(found, 0.5 * (nearest + aside.centre_world))
    never = _halfway(painted(aside, -1), views).centre_world
    assert (never - found).norm() <= 0.5 * (nearest - aside.centre_world).norm()
