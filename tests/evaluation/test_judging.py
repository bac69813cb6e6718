"""Scores of several cameras, and what they make together."""

import pytest
from gaussian_world import scene_trained_on
from toy_street import ToyStreet

from lidarpainter_models.conditioning.settings import ConditionConfig
from lidarpainter_models.evaluation.held_out import HeldOut
from lidarpainter_models.evaluation.judging import Judgement
from lidarpainter_models.evaluation.settings import JudgeConfig, ScoringConfig
from lidarpainter_models.evaluation.shown import ShownScene
from lidarpainter_models.observations.settings import ObservationConfig

FRONT, SIDE = "front", "side"
JUDGED_FRAMES = (1, 2)


@pytest.fixture(scope="module")
def scores():
    """Of a scene that holds nothing of the street, by a bright and a dark camera."""
    street = ToyStreet(4, ((FRONT, 1.0), (SIDE, 0.5)))
    street.manifest = {}
    tests = tuple(view for view in street.views if view.frame_index in JUDGED_FRAMES)
    observation = ObservationConfig(width_px=60)
    config = JudgeConfig(
        observation=observation, scoring=ScoringConfig(shifts=()), conditions=ConditionConfig()
    )
    held_out = HeldOut(scene=street, test_views=tests, observation=observation)
    fitted = scene_trained_on([view for view in street.views_of(FRONT) if view not in tests])
    judgement = Judgement(held_out=held_out, config=config)
    return judgement.scores(ShownScene(scene=fitted), lambda *_done: None)


def test_views_of_all_cameras_have_their_score(scores):
    by_view = scores["recorded"]["psnr_by_view"]
    assert set(by_view) == {f"{name}/{frame}" for name in (FRONT, SIDE) for frame in JUDGED_FRAMES}
    assert scores["recorded"]["psnr"] == pytest.approx(sum(by_view.values()) / len(by_view))
    for name in (FRONT, SIDE):
        own = scores["recorded_by_camera"][name]["psnr_by_view"]
        assert own.items() <= by_view.items()
