"""What operators read: the log of a worker, the file of metrics, the page about a fleet."""

import json
import re

import pytest
from commands import refuse, succeed
from prometheus_client.parser import text_string_to_metric_families
from stub_fleet import asked_ledger, behave, stub_worker, write_stub_manifest

from catalog.records import metric_row
from catalog.retries import Ending
from flows.fleet.report import fleet_page
from flows.fleet.worker import EventLog
from lidarpainter_models.export.report import render_report
from tasks.progress import listener, listening, working_on

STREETS = [f"synthetic/street-{seed:04d}" for seed in range(1, 5)]
MONEY = "money_per_hour = 3600\n"
MOST_BYTES = 5_000_000


@pytest.fixture(scope="module")
def worked(tmp_path_factory):
    """A fleet of four streets of which one was set aside, its store, and what its worker logged."""
    folder = tmp_path_factory.mktemp("fleet")
    ledger = asked_ledger(folder / "store", write_stub_manifest(folder, more=MONEY))
    store = ledger.store
    behave(store.root, STREETS[1], "bad")
    lines = []
    stub_worker(store.root, "stub", say=EventLog("stub", lines.append)).run()
    return ledger, store, lines


def test_each_line_of_the_log_is_one_event_of_one_scene(worked):
    _ledger, _store, lines = worked
    assert all(line.endswith("\n") and line.count("\n") == 1 for line in lines)
    events = [json.loads(line) for line in lines]
    assert {event["fleet"] for event in events} == {"stub"}
    assert all(re.fullmatch(r"\d{4}-\d\d-\d\dT[\d:.]+\+00:00", one["time"]) for one in events)
    told = [event["text"] for event in events if event.get("scene") == STREETS[1]]
    assert len(told) == 2
    assert "begins, attempt 1" in told[0]
    assert "bad-input" in told[1]
    assert {event["scene"] for event in events} == set(STREETS)


def test_stages_are_told_with_scene_and_run():
    lines = []
    with listening(EventLog("night", lines.append)):
        with working_on(scene="toy/a"), working_on(run="f00"):
            listener().started("fit")
            listener().advanced("fit", 1, 2, "30 dB")
            listener().waiting("fit", "17")
            listener().finished("fit", 61.23456, is_new=True)
        listener().started("fit")
    events = [json.loads(line) for line in lines]
    assert [one["event"] for one in events] == [
        *("stage-began", "stage-waits", "stage-ended"),
        "stage-began",
    ]
    for one in events[:3]:
        assert (one["scene"], one["run"], one["stage"]) == ("toy/a", "f00", "fit")
    assert (events[2]["seconds"], events[2]["is_new"]) == (61.235, True)
    assert "scene" not in events[3]


def test_metrics_are_read_by_their_own_parser(worked, tmp_path):
    _ledger, store, _lines = worked
    path = tmp_path / "textfile" / "night.prom"
    succeed("fleet", "status", "stub", "--metrics", path, store=store)
    families = {one.name: one for one in text_string_to_metric_families(path.read_text("utf-8"))}
    states = {
        one.labels["state"]: one.value for one in families["lidarpainter_fleet_sequences"].samples
    }
    assert states == {"waiting": 0, "running": 0, "done": 3, "set-aside": 1, "failed": 0}
    attempts = families["lidarpainter_fleet_attempts"]
    assert attempts.type == "counter"
    ended = {one.labels["cause"]: one.value for one in attempts.samples if "total" in one.name}
    assert ended == {"done": 3, "bad-input": 1}
    assert families["lidarpainter_fleet_cpu_seconds"].samples[0].value > 0
    assert families["lidarpainter_store_free_bytes"].samples[0].value > 0
    assert families["lidarpainter_fleet_last_end_seconds"].samples[0].value > 1.7e9
    assert [one.name for one in path.parent.iterdir()] == ["night.prom"]


def test_metrics_that_cannot_be_written_are_one_line(worked, tmp_path):
    (tmp_path / "file").touch()
    assert "cannot write" in refuse(
        "fleet", "status", "stub", "--metrics", tmp_path / "file/x.prom", store=worked[1]
    )


def test_the_page_says_what_happened_and_stands_alone(worked, tmp_path):
    ledger, store, _lines = worked
    for number, row in enumerate(ledger.rows("stub")):
        if row["run_id"]:
            scored = {"protocol": "recorded", "trajectory": "recorded", "name": "psnr"}
            scored |= {"value": 20.0 + number}
            scored_row = metric_row(row["run_id"], row["scene_id"], "refined", **scored)
            store.tables.merge("metrics", [scored_row])
    out = tmp_path / "night.html"
    answer = succeed("fleet", "report", "stub", "--out", out, "--json", store=store).json
    assert answer["num_bytes"] == out.stat().st_size < MOST_BYTES
    page = out.read_text("utf-8")
    assert not re.search(r"(src|href)=\"(?!data:)", page)
    assert "4 sequences: 3 done, 1 set-aside" in page
    assert f"{STREETS[1]}: the third image is damaged" in page
    report = fleet_page(ledger, "stub")
    tables = {table.title: table.rows for table in report.tables}
    assert [row[0] for row in tables["Worst scenes"]] == [STREETS[0], STREETS[2], STREETS[3]]
    (quality,) = tables["Quality of held-out views"]
    assert quality[:1] + quality[-1:] == ["psnr", 3]
    assert (quality[1], quality[3], quality[5]) == (20.0, 22.0, 23.0)
    causes = {row[0]: row for row in tables["Attempts and what they cost"]}
    assert set(causes) == {"done", "bad-input"}
    spent_s = sum(row["seconds"] for row in ledger.rows("stub"))
    assert sum(row[-1] for row in causes.values()) == pytest.approx(spent_s)  # one a second
    assert {plot.title for plot in report.plots} == {"Throughput", "Cost", "Quality"}
    assert "Worst views" not in render_report(report)


def test_an_attempt_that_older_code_left_without_a_cause_is_told_as_unknown(tmp_path):
    ledger = asked_ledger(tmp_path / "store", write_stub_manifest(tmp_path))
    store = ledger.store
    (row,) = [row for row in ledger.rows("stub") if row["scene_id"] == STREETS[0]]
    ledger.end(ledger.take(row, {}), Ending(cause="error", seconds=2.0))
    (attempt,) = store.tables.rows("attempts")
    store.tables.merge("attempts", [{**attempt, "attempt_id": "older", "cause": None}])
    metrics = tmp_path / "stub.prom"
    succeed("fleet", "status", "stub", "--metrics", metrics, store=store)
    assert 'cause="unknown"' in metrics.read_text("utf-8")
    succeed("fleet", "report", "stub", "--out", tmp_path / "stub.html", store=store)
    tables = {table.title: table.rows for table in fleet_page(ledger, "stub").tables}
    causes = {row[0]: row[1] for row in tables["Attempts and what they cost"]}
    assert causes == {"error": 1, "unknown": 1}


def test_a_fleet_that_nobody_has_begun_has_a_page_and_an_unknown_one_has_none(tmp_path):
    store = asked_ledger(tmp_path / "store", write_stub_manifest(tmp_path)).store
    out = tmp_path / "night.html"
    succeed("fleet", "report", "--out", out, store=store)
    assert "Nobody has begun." in out.read_text("utf-8")
    assert "no fleet 'other'" in refuse(
        "fleet", "report", "other", "--out", tmp_path / "x.html", store=store
    )
    assert not (tmp_path / "x.html").exists()
