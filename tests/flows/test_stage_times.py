"""Remaining times: past runs tell, the present one corrects them, and nothing is made up."""

import json
from datetime import UTC, datetime

import pytest

from flows.cli.output import set_loudness
from flows.cli.progress import how_far, shown_progress
from flows.cli.stage_times import Clock, PlannedStage, as_clock, expected_seconds
from flows.overrides import with_overrides
from flows.presets import preview
from tasks.progress import listener

STEPS = {"fit": 1500, "refine": 500}
RECORDED_S = {
    "prepare": 6.7,
    "fit": 88.0,
    "paint-1": 21.0,
    "refine-1": 39.0,
    "paint-2": 22.0,
    "refine-2": 41.0,
    "examine": 5.0,
    "evaluate-unpainted": 9.0,
    "evaluate": 9.5,
    "envelope": 4.0,
    "report": 3.0,
    "total": 249.0,
}
"""Wall times of a street of 14 training views, the preview preset, two cores."""


class Time:
    def __init__(self):
        self.s = 1000.0

    def __call__(self):
        return self.s


def past(day=1, **changes):
    row = {
        "status": "complete",
        "preset": "preview",
        "finished_at": datetime(2026, 11, day, tzinfo=UTC),
        "stage_seconds": json.dumps(RECORDED_S),
        "parameters": json.dumps({name: {"steps": steps} for name, steps in STEPS.items()}),
        "num_views": 28,
    }
    return row | changes


def planned(views=28, steps=STEPS, **changes):
    parameters = with_overrides(
        preview("a/b").model_copy(update=changes),
        [f"{name}.steps={count}" for name, count in steps.items()],
    )
    return [
        PlannedStage(name=name, amount=steps or views, has_steps=steps is not None)
        for name, steps in parameters.stages.items()
    ]


def play(clock, seconds, until_s):
    """Go through stages of those seconds, ten parts each, up to a time; returns what is left."""
    began_s = clock.now.s
    for stage, stage_s in seconds.items():
        clock.started(stage)
        clock.advanced(stage, 0.0)
        for part in range(10):
            if clock.now.s - began_s >= until_s:
                return clock.run_left(stage)
            # the first steps of a fit look at smaller images and are twice as fast
            is_fast = stage == "fit" and part < 5
            clock.now.s += stage_s / 10 * ((2 / 3 if is_fast else 4 / 3) if stage == "fit" else 1)
            clock.advanced(stage, (part + 1) / 10)
        clock.finished(stage, is_new=True)
    return 0.0


@pytest.mark.parametrize("slower", [0.5, 0.8, 1.0, 1.4, 2.0])
@pytest.mark.parametrize("views", [20, 28, 60])
def test_after_a_fifth_of_a_run_the_rest_is_known_to_a_third(slower, views):
    real_s = {
        name: seconds * slower * (1 if name.startswith(("fit", "refine")) else views / 28)
        for name, seconds in RECORDED_S.items()
        if name != "total"
    }
    clock = Clock(expected=expected_seconds(planned(views), "preview", [past()]), now=Time())
    total_s = sum(real_s.values())
    for gone in (0.2, 0.4, 0.6, 0.8):
        clock = Clock(expected=expected_seconds(planned(views), "preview", [past()]), now=Time())
        left_s = play(clock, real_s, gone * total_s)
        gone_s = clock.now.s - 1000.0
        assert left_s == pytest.approx(total_s - gone_s, rel=0.3)


def test_the_newest_complete_run_of_the_preset_tells():
    newer_s = {name: 2 * seconds for name, seconds in RECORDED_S.items()}
    rows = [
        past(day=2, stage_seconds=json.dumps(newer_s)),
        past(day=3, preset="paper"),
        past(day=4, status="failed"),
        past(day=1),
    ]
    found = expected_seconds(planned(views=14), "preview", rows)
    assert found["fit"] == pytest.approx(2 * 88.0)
    assert found["prepare"] == pytest.approx(6.7)
    assert found["refine-1"] == pytest.approx(2 * 40.0)
    assert list(found) == [name for name in RECORDED_S if name != "total"]


def test_where_steps_follow_the_views_their_time_does_too():
    left_open = json.dumps({name: {"steps": 0} for name in STEPS})
    rows = [past(day=1, parameters=left_open), past(day=2)]
    found = expected_seconds(planned(views=56, steps={}), "preview", rows)
    assert found["fit"] == pytest.approx(2 * 88.0)
    assert found["prepare"] == pytest.approx(2 * 6.7)
    assert expected_seconds(planned(steps={}), "preview", [past()]) is None


def test_no_past_run_no_word_about_the_run():
    assert expected_seconds(planned(), "preview", []) is None
    assert expected_seconds(planned(judge_view_time=True), "preview", [past()]) is None
    clock = Clock(now=Time())
    clock.started("fit")
    assert clock.run_left("fit") is clock.left("fit") is None
    assert how_far(clock, "fit", 0, None) == "0:01 gone"
    clock.advanced("fit", 0.0)
    clock.now.s += 30
    clock.advanced("fit", 0.25)
    assert clock.left("fit") == pytest.approx(90)
    assert how_far(clock, "fit", 375, 1500, "20 dB") == "375/1500 25 %, 0:30 gone, 1:30 left, 20 dB"


def test_making_ready_says_nothing_about_the_speed():
    clock = Clock(now=Time())
    clock.started("fit")
    for _ in range(3):
        clock.now.s += 60
        clock.advanced("fit", 0.0)
        assert clock.left("fit") is None
    clock.now.s += 10
    clock.advanced("fit", 0.5)
    assert clock.left("fit") == pytest.approx(10)


def test_what_kernels_took_to_compile_is_not_expected_again():
    compiled_s = 0.0
    clock = Clock(now=Time(), compiled=lambda: compiled_s)
    clock.started("fit")
    clock.advanced("fit", 0.0)
    clock.now.s += 30
    compiled_s = 20.0
    clock.advanced("fit", 0.25)
    assert clock.elapsed("fit") == 30
    assert clock.left("fit") == pytest.approx(30)


def test_no_stage_is_over_before_it_is():
    clock = Clock(expected={"fit": 10.0, "report": 5.0}, now=Time())
    clock.started("fit")
    clock.now.s += 60
    assert clock.left("fit") is None  # longer than was thought: how much longer nobody knows
    assert "0:00" not in how_far(clock, "fit", 1, 2)
    assert clock.run_left("fit") == pytest.approx(5.0)


def test_what_was_there_says_nothing_about_the_pace():
    clock = Clock(expected={"prepare": 10.0, "fit": 100.0}, now=Time())
    clock.started("prepare")
    clock.finished("prepare", is_new=False)
    clock.started("fit")
    assert clock.run_left("fit") == pytest.approx(100.0)


def test_times_are_read_as_on_a_clock():
    assert [as_clock(one) for one in (0.0, 48.4, 190, 3725)] == ["0:01", "0:48", "3:10", "1:02:05"]


def test_lines_say_what_bars_say_and_quiet_says_nothing(capsys, monkeypatch):
    monkeypatch.setattr("flows.cli.progress.LINE_EVERY_S", 0.0)
    for loudness in ("usual", "quiet"):
        set_loudness(loudness)
        with shown_progress({"fit": 100.0, "report": 50.0}):
            listener().started("fit")
            listener().advanced("fit", 750, 1500, "25 dB")
            listener().finished("fit", 3.0, is_new=True)
        set_loudness("usual")
    said = capsys.readouterr().err.splitlines()
    assert len(said) == 2
    assert said[0].startswith("fit: 750/1500 50 %, 0:01 gone")
    assert "; run 0:01 gone" in said[0]
    assert said[0].endswith("left, 25 dB")


def test_a_last_stage_that_takes_longer_than_was_thought_still_tells_of_the_run():
    class Now:
        s = 0.0

    clock = Clock(expected={"report": 2.0}, now=lambda: Now.s)
    clock.started("report")
    Now.s = 5.0
    assert clock.run_left("report") is None
    assert how_far(clock, "report", 1, 1) == "100 %, 0:05 gone; run 0:05 gone"


def test_a_round_that_is_made_again_is_foretold_by_what_it_took():
    now = Time()
    clock = Clock(expected={"refine-1": 40.0, "paint-2": 20.0, "refine-2": 40.0}, now=now)
    clock.started("refine-1")
    now.s += 80
    clock.finished("refine-1", is_new=True)
    clock.started("refine-1-unpainted")
    told = how_far(clock, "refine-1-unpainted", 0, 500)
    left_s = clock.left("refine-1-unpainted")
    assert left_s == pytest.approx(80, rel=0.05)
    assert clock.run_left("refine-1-unpainted") == pytest.approx(left_s * 100 / 40)
    assert "run 1:20 gone" in told
