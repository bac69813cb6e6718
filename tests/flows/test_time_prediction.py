"""Remaining times: past runs tell, the present one corrects them, and nothing is made up."""

import json
from datetime import UTC, datetime
from pathlib import Path

import pytest

from flows.cli.output import set_loudness
from flows.cli.progress import how_far, shown_progress
from flows.overrides import with_overrides
from flows.presets import preset, preview
from flows.time_prediction import (
    COMPILING_S,
    FIRST_SHARE,
    Clock,
    as_clock,
    expected_seconds,
)
from tasks.progress import listener

RECORDINGS = sorted(Path(__file__).with_name("recorded_runs").glob("*.json"))
"""What the stages of first runs said: second, seconds of compiling so far, event, stage, share."""
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


def parameters(steps=STEPS, **changes):
    return with_overrides(
        preview("a/b").model_copy(update=changes),
        [f"{name}.steps={count}" for name, count in steps.items()],
    )


def past(day=1, **changes):
    row = {
        "status": "complete",
        "finished_at": datetime(2026, 11, day, tzinfo=UTC),
        "stage_seconds": json.dumps(RECORDED_S),
        "parameters": parameters().model_dump_json(),
        "num_views": 28,
    }
    return row | changes


def clock_of(views=28, rows=(), **changes):
    expected, is_told = expected_seconds(parameters(**changes), views, rows)
    return Clock(expected=expected, is_told_by_past=is_told, now=Time())


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
    total_s = sum(real_s.values())
    for gone in (0.2, 0.4, 0.6, 0.8):
        clock = clock_of(views, [past()])
        left_s = play(clock, real_s, gone * total_s)
        gone_s = clock.now.s - 1000.0
        assert left_s == pytest.approx(total_s - gone_s, rel=0.3)


def test_the_newest_complete_run_tells_whatever_its_preset():
    newer_s = {name: 2 * seconds for name, seconds in RECORDED_S.items()}
    rows = [
        past(day=2, stage_seconds=json.dumps(newer_s)),
        past(day=5, parameters='{"scene": "of another version"}'),
        past(day=4, status="failed"),
        past(day=1),
    ]
    found, is_told = expected_seconds(parameters(), 28, rows)
    assert is_told
    assert found["fit"] == pytest.approx(2 * 88.0)
    assert found["refine-1"] == pytest.approx(2 * 40.0)
    assert found["evaluate"] == pytest.approx(2 * 9.25)
    assert list(found) == [name for name in RECORDED_S if name != "total"]
    smaller, _ = expected_seconds(parameters({"fit": 750, "refine": 500}), 14, rows)
    assert smaller["fit"] == pytest.approx(88.0, rel=0.05)
    assert smaller["prepare"] == pytest.approx(6.7)


def test_a_first_run_is_told_after_its_first_fifth_alone():
    found, is_told = expected_seconds(parameters(), 28, [])
    assert not is_told
    assert list(found) == [name for name in RECORDED_S if name != "total"]
    clock = clock_of()
    clock.started("prepare")
    assert clock.place("prepare") == "stage 1 of 11"
    assert clock.run_left("prepare") is clock.left("prepare") is None
    clock.now.s += 0.3 * sum(found.values())
    assert clock.run_left("prepare") > 0


def test_no_plan_no_word_about_the_run():
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
    assert clock.left("fit") is None
    clock.now.s += 10
    clock.advanced("fit", 0.5)
    assert clock.left("fit") == pytest.approx(20)


def test_what_a_first_stage_compiled_tells_of_those_to_come():
    def fits_left(share):
        """Of a fit that begins after a stage in which so much of its kernels was compiled."""
        compiled_s = share * COMPILING_S["prepare"]
        clock = Clock(
            expected={"prepare": 6.0, "fit": 40.0},
            is_told_by_past=True,
            now=Time(),
            compiled=lambda: compiled_s if clock.now.s > 1000.0 else 0.0,
        )
        clock.started("prepare")
        clock.now.s += 6.0 + compiled_s
        clock.finished("prepare", is_new=True)
        clock.started("fit")
        return clock.left("fit")

    assert fits_left(0.0) == pytest.approx(40.0)
    assert fits_left(1.0) == pytest.approx(40.0 + COMPILING_S["fit"])


def test_no_stage_is_over_before_it_is():
    clock = Clock(expected={"fit": 10.0, "report": 5.0}, is_told_by_past=True, now=Time())
    clock.started("fit")
    clock.now.s += 60
    assert clock.left("fit") is None  # longer than was thought: how much longer nobody knows
    assert "0:00" not in how_far(clock, "fit", 1, 2)
    assert clock.run_left("fit") == pytest.approx(5.0)


def test_what_was_there_says_nothing_about_the_pace():
    clock = Clock(expected={"prepare": 10.0, "fit": 100.0}, is_told_by_past=True, now=Time())
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
    assert len(said) == 3
    assert said[0].startswith("fit: stage 1 of 2 begins; run 0:01 gone, 2:30 left")
    assert said[1].startswith("fit: stage 1 of 2, 750/1500 50 %, 0:01 gone")
    assert "; run 0:01 gone" in said[1]
    assert said[1].endswith("left, 25 dB")


def test_a_last_stage_that_takes_longer_than_was_thought_still_tells_of_the_run():
    clock = Clock(expected={"report": 2.0}, is_told_by_past=True, now=Time())
    clock.started("report")
    clock.now.s += 5.0
    assert clock.run_left("report") is None
    told = how_far(clock, "report", 1, 1)
    assert told == "stage 1 of 1, 99 %, 0:05 gone; run 0:05 gone"


def test_a_round_that_is_made_again_is_foretold_by_what_it_took():
    clock = Clock(
        expected={"refine-1": 40.0, "paint-2": 20.0, "refine-2": 40.0},
        is_told_by_past=True,
        now=Time(),
    )
    clock.started("refine-1")
    clock.now.s += 80
    clock.finished("refine-1", is_new=True)
    clock.started("refine-1-unpainted")
    told = how_far(clock, "refine-1-unpainted", 0, 500)
    left_s = clock.left("refine-1-unpainted")
    assert left_s == pytest.approx(80, rel=0.1)
    assert clock.run_left("refine-1-unpainted") == pytest.approx(left_s * 100 / 40, rel=0.05)
    assert told.startswith("stage 2 of 4")
    assert "run 1:20 gone" in told


@pytest.mark.parametrize("path", RECORDINGS, ids=lambda path: path.stem)
def test_a_real_first_run_is_told_right_from_its_first_fifth_on(path):
    """Replayed from what stages said; times are those of the machine that it was recorded on."""
    recorded = json.loads(path.read_text("ascii"))
    events = recorded["events"]
    settings = with_overrides(preset(recorded["preset"], recorded["scene"]), recorded["settings"])
    counts = recorded["num_views"], [], recorded["num_recorded"]
    expected, _ = expected_seconds(settings, *counts)
    at = [0.0, 0.0]
    clock = Clock(expected=expected, now=lambda: at[0], compiled=lambda: at[1])
    end_s, tried = events[-1][0], 0
    for time_s, compiled_s, what, stage, *facts in events:
        at[:] = time_s, compiled_s
        if what == "started":
            clock.started(stage)
            assert clock.place(stage) == f"stage {list(expected).index(stage) + 1} of 11"
        elif what == "finished":
            clock.finished(stage, is_new=True)
            continue
        else:
            clock.advanced(stage, facts[0])
            assert "100 %" not in how_far(clock, stage, facts[0], 1.0)
        if FIRST_SHARE * end_s <= time_s:
            left_s, true_s = clock.run_left(stage) or 0.0, end_s - time_s
            tried += 1
            # the last seconds of a run are not known to a third
            assert left_s == pytest.approx(true_s, rel=0.3, abs=0.03 * end_s), (stage, time_s)
    assert tried > 100
