"""Held-out frames of a log move what is promised of it, as far as they are many and agree."""

import json
from dataclasses import asdict, replace

import pytest
import torch
from gaussian_world import FRAME_NS, build_world, camera_at
from toy_street import ToyStreet

from lidarpainter_models.conditioning.view_evidence import EvidenceGatherer, ViewEvidence
from lidarpainter_models.evaluation.anchoring import (
    UNLIKE_DB,
    JudgedFrame,
    calibration_of,
    judged_frames,
    predicted_and_measured,
    what_frames_say,
)
from lidarpainter_models.evaluation.held_out import HeldOut
from lidarpainter_models.evaluation.view_confidence import BUNDLED, LEAST_FRAMES, Calibration
from lidarpainter_models.evaluation.view_scores import ScoredView
from lidarpainter_models.observations.settings import ObservationConfig

LINE = Calibration(
    intercept_db=0.0,
    weights={"expected_db": 1.0, "support": 5.0},
    offset_db=0.0,
    spread_db=0.8,
    record="made up",
)
MANY = 24


def evidence(expected_db, support=0.0):
    return ViewEvidence(recorded_db=0.0, expected_db=expected_db, support=support)


def scattered(mean_db, *, by_db=1.0, count=MANY, at_db=25.0):
    """Frames as predicted and measured: off by that mean, half of them above it and half below."""
    return [(at_db, at_db + mean_db + by_db * (-1) ** number) for number in range(count)]


def test_a_log_that_is_8_db_worse_than_predicted_promises_nothing_at_25_db():
    frame = evidence(30.0)
    assert LINE.of(frame).is_promised
    anchored = LINE.anchored(scattered(-8.0)).of(frame)
    assert anchored.predicted_db == pytest.approx(22.0, abs=0.2)
    assert anchored.confidence < 0.15
    assert not LINE.anchored(scattered(-8.0)).of(evidence(33.0)).is_promised


def test_a_log_that_is_better_than_predicted_promises_more():
    frame = evidence(25.0)
    assert not LINE.of(frame).is_promised
    assert LINE.anchored(scattered(5.0)).of(frame).is_promised


def test_a_raise_is_for_frames_with_as_much_evidence_as_the_held_out_ones():
    better, worse = (LINE.anchored(scattered(mean_db, at_db=28.0)) for mean_db in (3.0, -3.0))
    raised = [better.of(evidence(db)).predicted_db - db for db in (24.0, 27.0, 27.5, 28.0, 30.0)]
    assert raised == pytest.approx([0, 0, 1.5, 3, 3], abs=0.1)
    lowered = [worse.of(evidence(db)).predicted_db - db for db in (20.0, 30.0)]
    assert lowered == pytest.approx([-3, -3], abs=0.1)


def test_few_frames_move_less_than_many_and_promise_less():
    few, many = (LINE.anchored(scattered(-6.0, by_db=4.0, count=count)) for count in (4, MANY))
    assert -6.0 < many.intercept_db < few.intercept_db - 1 < -1
    assert few.spread_db > many.spread_db > LINE.spread_db


def test_frames_of_a_log_that_scatter_promise_less_than_those_that_agree():
    agreeing, doubtful = (LINE.anchored(scattered(0.0, by_db=size)) for size in (1.0, 5.0))
    assert agreeing.spread_db == pytest.approx(LINE.spread_db, rel=0.05)
    assert doubtful.spread_db > 2.5 * LINE.spread_db
    assert agreeing.of(evidence(28.0)).is_promised
    assert not doubtful.of(evidence(28.0)).is_promised


@pytest.mark.parametrize("count", [0, LEAST_FRAMES - 1])
def test_a_log_without_held_out_frames_promises_less_and_says_so(count):
    unchecked = LINE.anchored([(20.0, 29.0)] * count)
    assert unchecked.intercept_db == LINE.intercept_db
    frame = evidence(27.5)
    assert LINE.of(frame).is_promised
    assert LINE.anchored(scattered(0.0)).of(frame).is_promised
    assert not unchecked.of(frame).is_promised
    assert unchecked.record == "made up; not checked against held-out frames of this log"
    said = what_frames_say([(20.0, 29.0)] * count)
    assert said == said | {"num_frames": count, "residual_db": None, "is_unlike": False}


@pytest.mark.parametrize(
    "known", [(), scattered(-8.0), scattered(6.0, by_db=9.0, count=3), scattered(4.0, at_db=20.0)]
)
def test_more_evidence_never_lowers_what_is_said_of_a_log(known):
    anchored = BUNDLED.anchored(known)
    frame = ViewEvidence(recorded_db=25.0, expected_db=22.0, support=0.6)
    for name in asdict(frame):
        more = replace(frame, **{name: getattr(frame, name) * 1.2})
        assert anchored.of(more).confidence > anchored.of(frame).confidence


def test_a_log_far_from_what_is_predicted_is_unlike():
    for mean_db, expected in ((UNLIKE_DB + 0.5, True), (-UNLIKE_DB - 0.5, True), (0.5, False)):
        said = what_frames_say(scattered(mean_db))
        assert said["residual_db"] == pytest.approx(mean_db)
        assert said["is_unlike"] is expected
        assert json.loads(json.dumps(said)) == said


def test_what_an_envelope_says_is_read_again():
    made = BUNDLED.anchored(scattered(-2.0))
    stored = {"calibration": asdict(made), "held_out": what_frames_say(scattered(-2.0))}
    assert calibration_of(json.loads(json.dumps(stored))) == made
    unchecked = BUNDLED.anchored(())
    assert calibration_of(None) == unchecked
    assert calibration_of({"calibration": "text of an older version"}) == unchecked


def test_frames_are_predicted_by_their_evidence():
    frame = JudgedFrame(name="front/1", evidence=evidence(20.0), psnr_db=17.0)
    expected = BUNDLED.of(frame.evidence).predicted_db
    assert predicted_and_measured([frame]) == [(expected, 17.0)]


class DarkTruth(HeldOut):
    """Held-out views that are 0.1 darker than a scene shows them, and wrong where they are hid."""

    def recorded_views(self, fitted, poses):
        assert poses == "interpolated"
        camera = camera_at(0.1)
        shown = fitted.render(camera, FRAME_NS, camera_name="front").rgb.clamp(0, 1)
        bonnet = torch.zeros(shown.shape[:2], dtype=torch.bool)
        bonnet[-10:] = True
        return [
            ScoredView(
                name=name,
                camera=camera,
                timestamp_ns=FRAME_NS,
                truth_rgb=shown - 0.1
                if hidden is None
                else shown - 0.1 - hidden[..., None].float(),
                actor_ids=(),
                actor_index=torch.zeros(shown.shape[:2], dtype=torch.int64),
                hidden=hidden,
            )
            for name, hidden in (
                ("front/1", None),
                ("front/3", bonnet),
                ("rear/1", torch.ones_like(bonnet)),
            )
        ]


def test_held_out_frames_are_judged_without_what_the_recording_car_hides():
    world = build_world()
    seen = world.observations
    gatherer = EvidenceGatherer(world.scene, seen.lidar_map, seen.views)
    street = ToyStreet(1)
    held_out = DarkTruth(scene=street, test_views=(), observation=ObservationConfig())
    frames = list(judged_frames(held_out, gatherer))
    assert [frame.name for frame in frames] == ["front/1", "front/3"]  # nothing else is in sight
    assert [frame.psnr_db for frame in frames] == pytest.approx([20.0, 20.0], abs=1e-3)
    assert frames[0].evidence == gatherer.of(camera_at(0.1), FRAME_NS, "front")
