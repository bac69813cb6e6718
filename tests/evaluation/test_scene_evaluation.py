"""Scores of several cameras and of each actor, and what they make together."""

import math
from dataclasses import replace

import pytest
import torch
from gaussian_world import scene_trained_on
from stub_inception import MeansAsFeatures
from toy_street import ToyStreet, world_from_car

from lidarpainter_models.conditioning.settings import ConditionConfig
from lidarpainter_models.evaluation import scene_evaluation
from lidarpainter_models.evaluation.held_out import HeldOut
from lidarpainter_models.evaluation.scene_evaluation import SceneEvaluation, _mean
from lidarpainter_models.evaluation.settings import EvaluationConfig, ScoringConfig
from lidarpainter_models.evaluation.shown import ShownScene
from lidarpainter_models.evaluation.view_scores import (
    NOBODY,
    ScoredView,
    actors_in_view,
    score_views,
)
from lidarpainter_models.geometry.shifts import Shift
from lidarpainter_models.lidar.points_on_actors import MovingBoxes
from lidarpainter_models.metrics.perceptual import PerceptualDistances
from lidarpainter_models.observations.settings import ObservationConfig

FRONT, SIDE = "front", "side"
JUDGED_FRAMES = (1, 2)


def judge():
    """Scores of a scene that holds nothing of the street, by two cameras, and their progress."""
    street = ToyStreet(4, ((FRONT, 1.0), (SIDE, 0.5)))
    street.manifest = {}
    tests = tuple(view for view in street.views if view.frame_index in JUDGED_FRAMES)
    observation = ObservationConfig(width_px=60)
    config = EvaluationConfig(
        observation=observation,
        scoring=ScoringConfig(shifts=(Shift(lateral_m=1.0),)),
        conditions=ConditionConfig(),
    )
    held_out = HeldOut(scene=street, test_views=tests, observation=observation)
    fitted = scene_trained_on([view for view in street.views_of(FRONT) if view not in tests])
    evaluation = SceneEvaluation(held_out=held_out, config=config)
    told = []
    return evaluation.scores(ShownScene(scene=fitted), lambda *step: told.append(step)), told


@pytest.fixture(scope="module")
def judged():
    """With no weights of any distance."""
    return judge()


@pytest.fixture(scope="module")
def scores(judged):
    return judged[0]


def test_every_render_is_told(judged):
    # four views, at both poses and, for depth, there and beside the path
    assert judged[1] == [(done, 4 * 4) for done in range(1, 4 * 4 + 1)]


def test_with_the_network_images_beside_the_path_are_held_against_recorded_ones(
    scores, monkeypatch
):
    assert scores["novel"]["left-1m"]["fid"] is None
    assert "Inception" in scores["novel"]["left-1m"]["fid_reason"]
    network = PerceptualDistances(inception=MeansAsFeatures())
    monkeypatch.setattr(scene_evaluation, "load_distances", lambda *_files, **_more: network)
    likened, told = judge()
    assert told == [(done, 4 * 5) for done in range(1, 4 * 5 + 1)]
    beside = likened["novel"]["left-1m"]
    assert beside["fid"] > 0.01
    assert (beside["num_real"], beside["num_shown"]) == (4, 4)
    assert beside["kid"] is not None


def test_views_of_all_cameras_have_their_score(scores):
    by_view = scores["recorded"]["psnr_by_view"]
    assert set(by_view) == {f"{name}/{frame}" for name in (FRONT, SIDE) for frame in JUDGED_FRAMES}
    assert scores["recorded"]["psnr"] == pytest.approx(sum(by_view.values()) / len(by_view))
    for name in (FRONT, SIDE):
        own = scores["recorded_by_camera"][name]["psnr_by_view"]
        assert own.items() <= by_view.items()


def test_an_actor_is_scored_over_the_pixels_of_all_cameras(scores):
    whole = scores["recorded"]["psnr_by_actor"]["car"]
    parts = [scores["recorded_by_camera"][name]["psnr_by_actor"]["car"] for name in (FRONT, SIDE)]
    assert whole["num_pixels"] == sum(part["num_pixels"] for part in parts)
    error = sum(part["num_pixels"] * 10 ** (-part["psnr"] / 10) for part in parts)
    assert whole["psnr"] == pytest.approx(-10 * math.log10(error / whole["num_pixels"]), abs=1e-9)
    assert parts[0]["psnr"] != pytest.approx(parts[1]["psnr"], abs=0.1)
    assert scores["recorded"]["actors_psnr"] == pytest.approx(whole["psnr"], abs=1e-4)


def test_a_camera_that_saw_no_actor_takes_none_from_the_others(scores):
    seen = scores["recorded_by_camera"][FRONT]
    blind = {**scores["recorded_by_camera"][SIDE], "actors_psnr": None, "psnr_by_actor": {}}
    assert _mean([seen, blind])["actors_psnr"] == pytest.approx(seen["actors_psnr"], abs=1e-4)


@pytest.fixture
def hidden():
    """A view of two cars, the far one listed last and half behind the near one."""
    street = ToyStreet()
    (near,), view = street.tracks, street.views[2]
    back = torch.eye(4, dtype=torch.float64)
    back[:2, 3] = torch.tensor([5.0, 2.0])
    far = replace(near, actor_id="far", world_from_box=back @ near.world_from_box)
    actor_ids, index = actors_in_view(view.camera, MovingBoxes([near, far]), view.timestamp_ns)
    alone, of_far = actors_in_view(view.camera, MovingBoxes([far]), view.timestamp_ns)
    assert (actor_ids, alone) == (("car", "far"), ("far",))
    return view, index, of_far == 0


def test_a_pixel_is_that_of_the_nearest_box(hidden):
    view, index, of_far = hidden
    centre = world_from_car(view.timestamp_ns * 1e-9)[None, :3, 3]
    u, v = view.camera.project(centre)[0][0].long().tolist()
    assert index[v, u] == 0
    assert bool((of_far & (index == 0)).any())
    assert torch.equal(index == 1, of_far & (index != 0))


def test_what_hides_an_actor_does_not_count_for_it(hidden):
    view, index, _of_far = hidden
    wrong = {NOBODY: 0.3, 0: 0.1, 1: 0.01}
    image = torch.zeros(*index.shape, 3)
    for number, error in wrong.items():
        image[index == number] = error
    judged = ScoredView(
        name="front/2",
        camera=view.camera,
        timestamp_ns=view.timestamp_ns,
        truth_rgb=torch.zeros_like(image),
        actor_ids=("car", "far"),
        actor_index=index,
    )
    scores = score_views(lambda *_place: image, [judged], distances=PerceptualDistances())
    assert scores.psnr_by_actor["car"].psnr == pytest.approx(20, abs=1e-4)
    assert scores.psnr_by_actor["far"].psnr == pytest.approx(40, abs=1e-4)
    assert scores.psnr_by_actor["far"].num_pixels == int((index == 1).sum())
