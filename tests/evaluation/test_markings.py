"""Painted lines are found where the road has them, missed where they are gone, and named."""

import copy

import numpy as np
import pytest
import torch
from gaussian_world import scene_trained_on

from lidarpainter_models.errors import ConfigError
from lidarpainter_models.evaluation.held_out import HeldOut
from lidarpainter_models.evaluation.markings import IMAGE, area_under_curve, markings_scores
from lidarpainter_models.evaluation.score_tables import MARKINGS, metric_values
from lidarpainter_models.evaluation.shown import ShownScene
from lidarpainter_models.geometry.shifts import Shift
from lidarpainter_models.observations.settings import ObservationConfig
from lidarpainter_models.scenes.driving_scene import DrivingScene
from lidarpainter_models.synthetic import SyntheticStreet
from lidarpainter_models.synthetic.config import DEFAULT_CAMERAS, SyntheticStreetConfig
from lidarpainter_models.synthetic.sequence import record_street

WIDTH_PX = 320
SIDE = "front_left_camera"
LEFT = Shift(lateral_m=2.0)


@pytest.fixture(scope="module")
def street():
    cameras = tuple(one for one in DEFAULT_CAMERAS if one.name in ("front_camera", SIDE))
    size = {"width_px": WIDTH_PX, "height_px": 200}
    return SyntheticStreet(SyntheticStreetConfig(seed=7, num_frames=3, cameras=cameras, **size))


@pytest.fixture(scope="module")
def scene(street, tmp_path_factory):
    return DrivingScene.open(record_street(street, tmp_path_factory.mktemp("street")))


def judged(scene, draw, cameras=("front_camera",)):
    """Scores of what `draw` makes of a camera and a time, at the middle frame."""
    views = [view for view in scene.views if view.camera_name in cameras]
    observation = ObservationConfig(width_px=WIDTH_PX)
    held_out = HeldOut(
        scene=scene, test_views=[v for v in views if v.frame_index == 1], observation=observation
    )
    fitted = scene_trained_on([view for view in views if view.frame_index != 1])

    class Drawn(ShownScene):
        def renderer(self, _camera_name):
            return draw

    done = []
    found = markings_scores(
        held_out, Drawn(scene=fitted), (LEFT,), lambda n, total: done.append((n, total))
    )
    assert done == [(n, len(done)) for n in range(1, len(done) + 1)]
    return found[MARKINGS]


def test_true_images_show_the_lines_and_grey_ones_do_not(street, scene):
    true = judged(scene, lambda camera, time_ns: street.render(camera, time_ns).rgb)
    grey = judged(scene, lambda camera, _: torch.full((camera.height_px, camera.width_px, 3), 0.4))
    for name in ("recorded", LEFT.name):
        assert true[name]["auc"] > 0.8
        assert true[name]["confirmed_auc"] > 0.8
        assert grey[name]["auc"] == 0.5
        assert true[name]["paint_psnr"] > grey[name]["paint_psnr"] + 20
        assert true[name]["paint_edge_error"] == pytest.approx(0.0, abs=1e-6)
        assert true[name]["told_by"] == "labels"
    assert true[IMAGE]["auc"] > 0.75
    assert "paint_psnr" not in true[IMAGE]


def test_lines_in_the_wrong_place_cost_as_much_as_missing_ones(street, scene):
    def aside(camera, time_ns):
        pose = camera.world_from_camera.clone()
        pose[:3, 3] += 0.6 * pose[:3, 0]
        return street.render(camera.at(pose), time_ns).rgb

    found = judged(scene, aside)
    assert found["recorded"]["auc"] < 0.75


def test_without_labels_what_returns_more_light_stands_in_and_is_named(street, scene):
    bare = copy.copy(scene)
    bare.semantic_classes = {}
    found = judged(bare, lambda camera, time_ns: street.render(camera, time_ns).rgb)
    assert found["recorded"]["told_by"] == "intensity"
    assert found["recorded"]["auc"] > 0.8


def test_few_points_give_no_figure_but_a_reason(scene, monkeypatch):
    monkeypatch.setattr("lidarpainter_models.evaluation.markings.FAR_M", 4.5)
    dark = judged(scene, lambda camera, _: torch.zeros(camera.height_px, camera.width_px, 3))
    assert dark["recorded"]["auc"] is None
    reasons = {row[1:3]: row[4] for row in metric_values({MARKINGS: dark})}
    assert "fewer than" in reasons["recorded", "auc"]


def test_cameras_that_look_aside_are_not_judged_by(scene):
    def never(_camera, _time_ns):
        raise AssertionError

    with pytest.raises(ConfigError, match="looks ahead"):
        judged(scene, never, cameras=(SIDE,))


def test_the_area_counts_pairs_and_halves_ties():
    higher, lower = np.array([3.0, 1.0]), np.array([0.0, 1.0, 2.0, 5.0])
    pairs = [(one > two) + 0.5 * (one == two) for one in higher for two in lower]
    assert area_under_curve(higher, lower) == pytest.approx(np.mean(pairs))
