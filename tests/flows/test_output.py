"""Tables and progress say what is so, in either kind of place they are shown."""

import json
import math

import pytest
from rich.console import Console
from rich.progress import Progress

from flows.cli.output import format_bytes, format_cell, print_json, print_pairs, print_table
from flows.cli.progress import Bars, Lines, shown_progress
from flows.cli.shared_options import in_words
from flows.time_prediction import Clock
from tasks.progress import listener


@pytest.mark.parametrize(
    ("value", "expected"),
    [(None, "-"), (True, "yes"), (29.53449, "29.534"), (7, "7"), ("a[bold]", "a[bold]"), ("", "-")],
)
def test_cells_are_short_and_never_markup(value, expected):
    assert format_cell(value) == expected


def test_what_is_known_of_images_is_said_in_words():
    told = in_words({"num_images": 28, "collisions": [], "num_trusted": 3})
    assert told["collisions"] == "none"
    assert told["promised"].startswith("3 of 28 views: before any painting")
    assert "25 dB or more, at a probability of at least 0.9" in told["promised"]
    assert "promised" not in in_words({"num_images": 28, "collisions": [], "num_trusted": None})


@pytest.mark.parametrize(
    ("num_bytes", "expected"), [(0, "0 B"), (999, "999 B"), (1500, "1.5 kB"), (2.5e9, "2.5 GB")]
)
def test_sizes_have_a_unit(num_bytes, expected):
    assert format_bytes(num_bytes) == expected


def test_json_stays_json_where_a_number_is_infinite(capsys):
    print_json({"psnr": math.inf, "views": [1, math.nan]})
    assert json.loads(capsys.readouterr().out) == {"psnr": None, "views": [1, None]}


def test_json_takes_few_lines(capsys):
    result = {"short": [1, 2], "views": {f"view-{number}": [number / 3] * 3 for number in range(9)}}
    print_json(result)
    out = capsys.readouterr().out
    assert json.loads(out) == result
    assert out.startswith('{\n  "short": [1, 2],\n  "views": {\n    "view-0": [0.0, 0.0, 0.0],\n')
    assert len(out.splitlines()) == 14


def test_a_table_shows_every_cell_under_words_with_units(capsys):
    print_table("scores", ["view", "psnr"], [["left-2m", 24.5], ["[x]", None]], "in dB")
    print_pairs("run", {"run_id": "abc", "error": None, "num_bytes": 1500})
    assert capsys.readouterr().out.splitlines() == [
        "scores",
        "view     PSNR, dB, higher is better",
        "-------  --------------------------",
        "left-2m                      24.500",
        "[x]                               -",
        "in dB",
        "run",
        "  run   abc",
        "  size  1.5 kB",
    ]


def test_a_table_fits_and_breaks_between_words(capsys):
    reason = "what is said about this row takes far more room than one line of a terminal has"
    rows = [["interpolated poses", reason, None, 1.0], ["recorded", "short", None, 2.0]]
    print_table("wide", ["view", "reason", "error", "flicker"], rows, num_text_columns=3)
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines)) <= 80
    assert "error" not in lines[1]
    words = " ".join(lines).split()
    assert {*reason.split(), "interpolated", "flicker,"} <= set(words)


def test_a_table_that_cannot_fit_is_told_row_by_row(capsys):
    path = "/a/path/" + "x" * 90
    print_table("files", ["path", "num_gaussians"], [[path, 3], ["/b", None]])
    lines = capsys.readouterr().out.splitlines()
    assert lines == ["files", "", f"  path       {path}", "  Gaussians  3", "", "  path  /b"]


def test_lines_say_how_a_stage_ended(capsys):
    lines = Lines(Clock())
    lines.started("fit")
    lines.advanced("fit", 1, 2, "30 dB")  # too soon to say anything
    lines.waiting("fit", "42")
    lines.finished("fit", 12.34, is_new=True)
    lines.started("paint")
    lines.finished("paint", 12.34, is_new=False)
    assert capsys.readouterr().err.splitlines() == [
        "fit: waiting for process 42, which computes the same",
        "fit: 12.3 s",
        "paint: was there",
    ]


def test_a_stage_that_takes_long_says_so_now_and_then(capsys, monkeypatch):
    monkeypatch.setattr("flows.cli.progress.LINE_EVERY_S", 0.0)
    lines = Lines(Clock())
    lines.started("fit")
    lines.advanced("fit", 1, 4, "30 dB")
    assert capsys.readouterr().err == "fit: 1/4 25 %, 0:01 gone, 30 dB\n"


def test_nothing_is_whole_before_its_end(capsys, monkeypatch):
    monkeypatch.setattr("flows.cli.progress.LINE_EVERY_S", 0.0)
    lines = Lines(Clock(expected={"fit": 9.0, "report": 1.0}))
    lines.started("fit")
    lines.advanced("fit", 1, 1, "30 dB")
    began, told = capsys.readouterr().err.splitlines()
    assert began.startswith("fit: stage 1 of 2 begins; run 0:01 gone")
    assert told.startswith("fit: stage 1 of 2, 99 %, 0:01 gone")
    with Progress("{task.percentage:.0f}", console=Console(force_terminal=True)) as progress:
        bars = Bars(progress, Clock())
        bars.started("fit")
        bars.advanced("fit", 500, 500, "")
        assert progress.tasks[0].percentage == 99
        bars.finished("fit", 3.0, is_new=True)
        assert progress.tasks[0].percentage == 100


def test_bars_follow_every_stage(capsys):
    console = Console(force_terminal=True, width=80)
    with Progress(
        "{task.description} {task.percentage:.0f} {task.fields[said]}", console=console
    ) as progress:
        bars = Bars(progress, Clock())
        bars.started("fit")
        bars.advanced("fit", 1, 2, "30 dB")
        bars.waiting("fit", "42")
        bars.finished("fit", 3.0, is_new=True)
        bars.started("paint")
        bars.finished("paint", 3.0, is_new=False)
    out = capsys.readouterr().out
    assert "fit 100 3.0 s" in out
    assert "paint 100 was there" in out


def test_progress_is_heard_inside_the_block_only(capsys):
    with shown_progress() as shown:
        assert listener() is shown
        listener().started("fit")
        listener().finished("fit", 1.0, is_new=True)
    assert listener() is not shown
    captured = capsys.readouterr()
    assert (captured.out, captured.err) == ("", "fit: 1.0 s\n")
