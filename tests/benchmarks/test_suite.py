"""The suite's own parts: what it counts, compares and writes."""

import json
import sys
from typing import Any

import pytest
import suite
import torch
from bench_raster import Stages, doublings
from bench_records import Figure, baseline_of, compared, kept_to, write_figures
from bench_scenes import street_like_splats
from bench_work import count_lanes

from lidarpainter_models.kernels.gaussian_raster.projection import IS_VISIBLE


def test_every_part_of_the_suite_runs_in_its_smallest_form(tmp_path, monkeypatch):
    out = tmp_path / "benchmarks.json"
    threads = torch.get_num_threads()
    monkeypatch.setattr(sys, "argv", ["suite.py", "--quick", "--out", str(out)])
    try:
        suite.main()
    finally:
        torch.set_num_threads(threads)
    measured = {figure["name"] for figure in json.loads(out.read_text("utf-8"))}
    baseline = json.loads(suite.BASELINE.read_text("utf-8"))
    # growth is measured at other sizes, whose names say so
    missing = {name for name in baseline if not name.startswith("growth.")} - measured
    assert missing == set()


def figure(**changes):
    values: dict[str, Any] = {"name": "one", "value": 6.0, "unit": "ms", "floor": 2.0, "limit": 4.0}
    return Figure(**values | changes)


def test_json_lists_exactly_what_readers_expect(tmp_path):
    path = tmp_path / "benchmarks.json"
    write_figures(path, [figure(), figure(name="two", unit="x", floor=None, threads=2)])
    first, second = json.loads(path.read_text("utf-8"))
    assert list(first) == ["name", "value", "unit", "floor", "ratio", "threads", "backend"]
    assert (first["ratio"], first["backend"]) == (3.0, "cpu")
    assert (second["ratio"], second["threads"]) == (None, 2)


def test_baseline_keeps_ratios_and_no_milliseconds():
    times = figure(name="bare", floor=None)
    speedup = figure(name="speedup", value=1.8, unit="x", floor=None)
    assert baseline_of([figure(), times, speedup]) == {"one": 3.0, "speedup": 1.8}


@pytest.mark.parametrize(
    ("value", "better", "verdict"),
    [(6.0, "lower", "ok"), (9.0, "lower", "worse"), (3.0, "lower", "ok"), (3.0, "higher", "worse")],
)
def test_a_change_beyond_the_tolerance_in_the_wrong_direction_is_worse(value, better, verdict):
    assert compared(figure(value=value, better=better), {"one": 3.0}).startswith(verdict)
    assert compared(figure(value=value), {}) == "-"


def test_limits_hold_in_the_direction_of_the_figure():
    assert kept_to(figure()).startswith("met")
    assert kept_to(figure(limit=2.9)).startswith("MISSED")
    assert kept_to(figure(better="higher", limit=3.1)).startswith("MISSED")
    assert kept_to(figure(limit=None)) == "-"


def test_growth_is_told_per_doubling():
    figures = {f.name: f.value for f in doublings("g", {100: 1.0, 400: 9.0}, "px")}
    assert figures["g.doubling.100-400_px"] == pytest.approx(3.0)


def test_lanes_counted_are_those_of_the_lists_and_hold_every_blend():
    stages = Stages(street_like_splats(400, 64, 48))
    lanes = count_lanes(stages.records, stages.lists, 48, 64)
    assert 0 < lanes.blended < lanes.evaluated <= len(stages.lists.gaussian) * 256
    nobody = stages.records.copy()
    nobody[:, IS_VISIBLE] = 0.0
    stages.records = nobody
    empty = count_lanes(nobody, stages.list_tiles(), 48, 64)
    assert (empty.evaluated, empty.blended) == (0, 0)
