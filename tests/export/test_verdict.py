"""The sentences say what the figures say, and no more."""

import pytest

from lidarpainter_models.export.verdict import verdict


def run(psnr=30.5, actors=30.0, depth=0.97, before=0.90, **changes):
    """What a run printed."""
    recorded = {"psnr": psnr, "actors_psnr": actors, "num_views": 14}

    def aside(part):
        return {"left-2m": {"depth_within_5_percent": part}, "up-1.5m": {"psnr": None}}

    result = {"painter": "nano", "recorded": recorded, "novel": aside(depth)}
    return {**result, "unpainted": {"novel": aside(before)}, **changes}


@pytest.mark.parametrize(
    ("figures", "position", "expected"),
    [
        ({}, 0, "Good: along the recorded path"),
        ({"psnr": 27.0}, 0, "Fair: "),
        ({"psnr": 20.0}, 0, "Poor: even along the recorded path"),
        ({}, 1, "Good: surfaces hold"),
        ({"depth": 0.9, "before": 0.8}, 1, "painting helped there (80% before)"),
        ({"depth": 0.7, "before": 0.8}, 1, "painting made it worse there"),
        ({"depth": 0.9, "before": 0.899}, 1, "painting changed nothing"),
        ({}, 2, "Good: moving actors are as sharp"),
        ({"actors": 25.0}, 2, "Weak: moving actors are worse than the street (25.0 against 30.5"),
        ({"actors": None}, 2, "No moving actor was judged"),
    ],
)
def test_sentence_follows_from_its_figure(figures, position, expected):
    sentences = verdict(run(**figures))
    assert len(sentences) == 3
    assert expected in sentences[position]


def envelope(**changes):
    """One stretch that is good to 3 m aside and another that is as said."""
    sides = dict.fromkeys(("left_m", "right_m", "up_m", "ahead_m"), 3.0)
    good = sides | {"yaw_left_deg": 20.0, "yaw_right_deg": 15.0}
    return {"good_db": 25.0, "stretches": [good, good | changes]}


def test_the_worst_stretch_says_how_far_all_of_it_can_be_trusted():
    sentence = verdict(run(envelope=envelope(right_m=1.5)))[2]
    assert sentence.startswith("All along, every frame is to be trusted (25 dB or more)")
    assert "up to 3 m left, 1.5 m right, 3 m up" in sentence
    assert "15 degrees" in sentence


def test_a_stretch_that_nobody_can_promise_is_no_number_and_takes_from_the_praise():
    nothing = dict.fromkeys(envelope()["stretches"][0])
    average, _, sentence, _ = verdict(run(envelope=envelope(**nothing)))
    assert average.startswith("Uneven: ")
    assert "on average (30.5 dB over 14 held-out views)" in average
    assert sentence.startswith("On 1 of 2 stretches single frames may fall below 25 dB even on the")
    assert "on the others every frame is to be trusted (25 dB or more) up to 3 m left" in sentence
    everywhere = {"good_db": 25.0, "stretches": [nothing]}
    assert verdict(run(envelope=everywhere))[2].startswith("Weak: on 1 of 1 stretches")


def log_check(residual_db, *, is_unlike):
    """An envelope whose held-out frames part so far from what was predicted."""
    said = {"num_frames": 24, "residual_db": residual_db, "is_unlike": is_unlike}
    return {**envelope(), "held_out": said}


@pytest.mark.parametrize(
    ("residual_db", "expected"), [(-9.24, "9.2 dB worse than"), (4.9, "4.9 dB better than")]
)
def test_a_log_unlike_all_that_confidence_was_calibrated_on_is_said_to_be(residual_db, expected):
    sentences = verdict(run(envelope=log_check(residual_db, is_unlike=True)))
    (sentence,) = [one for one in sentences if one.startswith("This log is unlike")]
    assert expected in sentence


def test_what_was_not_checked_on_the_log_is_said_to_be_unchecked():
    unchecked = verdict(run(envelope=log_check(None, is_unlike=False)))
    (sentence,) = [one for one in unchecked if "checked" in one]
    assert "not checked against held-out frames of this log" in sentence
    older = verdict(run(envelope=envelope()))
    assert verdict(run(envelope=log_check(0.5, is_unlike=False))) == older
    assert set(unchecked) - {sentence} == set(older)


def test_worst_of_several_ways_is_named():
    novel = {
        "left-2m": {"depth_within_5_percent": 0.96},
        "right-3m": {"depth_within_5_percent": 0.8},
    }
    sentence = verdict(run(novel=novel))[1]
    assert sentence.startswith("Poor: surfaces beside the path tear; worst is right-3m")


def test_nothing_is_said_of_painting_where_nobody_painted():
    assert "painting" not in verdict(run(painter="none"))[1]


def test_unjudged_scene_is_not_praised():
    (sentence,) = verdict(run(recorded=None))
    assert "Nobody judged" in sentence


def test_a_sample_of_the_held_out_views_is_called_one():
    recorded = {"psnr": 28.0, "actors_psnr": None, "num_views": 48, "num_held_out": 500}
    assert "(28.0 dB over 48 of 500 held-out views)" in verdict(run(recorded=recorded))[0]
    recorded = {**recorded, "num_held_out": 48}
    assert "(28.0 dB over 48 held-out views)" in verdict(run(recorded=recorded))[0]


def test_a_fit_that_ended_at_its_time_limit_is_called_early():
    assert verdict(run(stopped_early=True))[-1] == "The fit ended early, at its time limit."
    assert "early" not in " ".join(verdict(run(stopped_early=False)))


def test_a_round_that_was_taken_back_is_named():
    kept = {"before_db": 24.0, "after_db": 25.0, "is_taken_back": False}
    lost = {"before_db": 25.0, "after_db": 23.96, "is_taken_back": True}
    sentences = verdict(run(gains={"refine-1": kept, "refine-2": lost}))
    assert sentences[-1].startswith("Round 2 was taken back")
    assert "25.0 to 24.0 dB" in sentences[-1]
    assert len(verdict(run(gains={"refine-1": kept}))) == len(verdict(run()))
