"""What speaks for a view falls where less is known of it, and where the scene shows it wrong."""

from dataclasses import replace

import pytest
import torch
from gaussian_world import FRAME_NS, build_world, camera_at, turned_camera

from lidarpainter_models.conditioning import view_evidence
from lidarpainter_models.conditioning.view_evidence import EvidenceGatherer


@pytest.fixture(scope="module")
def world():
    return build_world()


def gatherer_of(world, scene=None):
    seen = world.observations
    return EvidenceGatherer(scene or world.scene, seen.lidar_map, seen.views)


def spoilt(scene, *, by):
    """The scene in other colours."""
    gaussians = scene.gaussians
    torch.manual_seed(0)
    other = gaussians.sh_dc + by * torch.randn_like(gaussians.sh_dc)
    return scene.with_gaussians(replace(gaussians, sh_dc=other))


def test_a_perfect_scene_agrees_with_what_was_recorded(world):
    found = gatherer_of(world).of(camera_at(0.15), FRAME_NS, "front")
    assert found.recorded_db > 45  # the images are its own renders, rounded to bytes
    assert found.expected_db > 20
    assert found.support > 0.7


def test_a_scene_in_wrong_colours_is_found_out(world):
    camera = camera_at(0.15)
    right = gatherer_of(world).of(camera, FRAME_NS, "front")
    wrong = gatherer_of(world, spoilt(world.scene, by=1.0)).of(camera, FRAME_NS, "front")
    assert wrong.recorded_db < right.recorded_db - 10
    assert wrong.expected_db < right.expected_db - 3


def test_less_speaks_for_what_nobody_looked_at(world):
    gatherer = gatherer_of(world)
    ahead, aside = (gatherer.of(turned_camera(yaw), FRAME_NS) for yaw in (0.0, 0.7))
    assert aside.support < ahead.support - 0.1
    assert aside.expected_db < ahead.expected_db - 1


def test_a_small_copy_of_a_view_says_much_the_same(world, monkeypatch):
    camera = camera_at(0.15)
    whole = gatherer_of(world).of(camera, FRAME_NS, "front")
    monkeypatch.setattr(view_evidence, "EVIDENCE_WIDTH_PX", 32)
    small = gatherer_of(world).of(camera, FRAME_NS, "front")
    assert small.recorded_db == whole.recorded_db  # at the size of the fit
    assert small.support == pytest.approx(whole.support, abs=0.15)


def test_a_training_view_that_shows_the_own_car_alone_says_nothing_of_the_fit(world):
    first, *others = world.observations.views
    nothing = replace(first, hidden=torch.ones_like(first.sky_mask))
    views = [nothing, *others, replace(nothing, key=(first.key[0], "covered"))]
    found = EvidenceGatherer(world.scene, world.observations.lidar_map, views)
    for name in ("front", "covered"):
        assert found.of(camera_at(0.15), FRAME_NS, name).recorded_db > 20


def test_what_hides_behind_the_own_car_vouches_for_nothing(world):
    hidden = torch.ones_like(world.observations.views[0].sky_mask)
    hidden[:4] = False
    views = [replace(view, hidden=hidden) for view in world.observations.views]
    found = EvidenceGatherer(world.scene, world.observations.lidar_map, views)
    camera = camera_at(0.15)
    shown = gatherer_of(world).of(camera, FRAME_NS, "front")
    assert found.of(camera, FRAME_NS, "front").expected_db < shown.expected_db - 3
