"""The command ends as it promises: codes, one line, and JSON alone on stdout."""

import json
from datetime import UTC, datetime

import pytest

from catalog.store import STORE_ENVIRONMENT, open_store
from flows.cli.main import globals_first, main


@pytest.fixture(autouse=True)
def own_store(tmp_path, monkeypatch):
    monkeypatch.setenv(STORE_ENVIRONMENT, str(tmp_path / "store"))
    (tmp_path / "store" / "tables").mkdir(parents=True)
    return open_store(tmp_path / "store")


@pytest.mark.parametrize("command", [[], ["--version"], ["ingest", "--help"]])
def test_asking_for_help_is_no_error(command, capsys):
    assert main(command) in ({0, 2} if not command else {0})
    assert "lidarpainter" in capsys.readouterr().out


def test_a_traceback_is_shown_only_when_asked_for(capsys):
    assert main(["catalog", "show", "x"]) == 2
    assert "Traceback" not in capsys.readouterr().err
    assert main(["catalog", "show", "x", "--debug"]) == 2
    assert "Traceback" in capsys.readouterr().err


def test_an_unexpected_error_is_one_line_and_code_one(monkeypatch, capsys):
    def fail():
        raise RuntimeError("out of\nluck")

    monkeypatch.setattr("catalog.store.open_store", fail)
    assert main(["catalog", "list"]) == 1
    assert capsys.readouterr().err == (
        "lidarpainter: unexpected RuntimeError: out of luck (--debug shows where)\n"
    )


def test_an_interrupt_ends_with_its_own_code(monkeypatch, capsys):
    def interrupt():
        raise KeyboardInterrupt

    monkeypatch.setattr("catalog.store.open_store", interrupt)
    assert main(["catalog", "list"]) == 130
    assert "goes on where this one stopped" in capsys.readouterr().err


def test_json_is_all_there_is_on_stdout(own_store, capsys):
    row = {"run_id": "r1", "status": "complete", "result": '{"psnr": 29.5}'}
    own_store.tables.merge("runs", [row])
    assert main(["catalog", "list", "runs", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["rows"][0]["result"] == {"psnr": 29.5}
    assert main(["catalog", "show", "r", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["run_id"] == "r1"


def test_tables_show_what_is_there(own_store, capsys):
    own_store.tables.merge("runs", [{"run_id": "r1", "status": "complete", "seconds": 12.5}])
    assert main(["catalog", "list"]) == 0
    assert "12.500" in capsys.readouterr().out


def test_the_newest_run_stands_first(own_store, capsys):
    for day, run_id in ((2, "r1"), (3, "r0"), (1, "r2")):
        started = datetime(2026, 1, day, 12, 30, tzinfo=UTC)
        own_store.tables.merge("runs", [{"run_id": run_id, "started_at": started}])
    assert main(["catalog", "list", "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)["rows"]
    assert [row["run_id"] for row in rows] == ["r0", "r1", "r2"]
    assert main(["catalog", "list"]) == 0
    assert "2026-01-03 12:30:00" in capsys.readouterr().out


def test_metrics_without_a_value_are_counted_once_by_reason(own_store, capsys):
    rows = [
        {"metric_id": f"m{number}", "name": "lpips", "value": None, "reason": "no weights"}
        for number in range(40)
    ]
    own_store.tables.merge("metrics", [*rows, {"metric_id": "p", "name": "psnr", "value": 30.5}])
    assert main(["catalog", "list", "metrics", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert [row["name"] for row in found["rows"]] == ["psnr"]
    assert found["absent"] == [{"names": {"lpips": 40}, "reason": "no weights"}]
    assert main(["catalog", "list", "metrics"]) == 0
    shown = capsys.readouterr().out
    assert shown.count("no weights") == 1
    assert "30.500" in shown


def test_deleting_asks_and_does_nothing_by_itself(own_store, capsys, monkeypatch):
    own_store.tables.merge("runs", [{"run_id": "r1", "status": "complete"}])
    assert main(["catalog", "delete", "r1", "--dry-run", "--json"]) == 0
    listed = json.loads(capsys.readouterr().out)
    assert listed["rows"] == [{"table": "runs", "id": "r1", "bytes": 0}]
    assert not listed["is_deleted"]
    assert main(["catalog", "delete", "r1"]) == 2
    assert "nobody can be asked whether to delete this, expected --yes" in capsys.readouterr().err
    monkeypatch.setattr("sys.stdin.isatty", lambda: True, raising=False)
    monkeypatch.setattr("typer.confirm", lambda _question: False)
    assert main(["catalog", "delete", "r1"]) == 2
    assert own_store.rows("runs") != []
    assert main(["catalog", "delete", "r1", "--yes", "--json"]) == 0
    assert own_store.rows("runs") == []


def test_global_options_may_stand_anywhere():
    words = ["ingest", "a", "--store", "s", "b", "--debug", "--", "--store"]
    assert globals_first(words) == ["--store", "s", "--debug", "ingest", "a", "b", "--", "--store"]
    assert globals_first(["list", "--store=s"]) == ["--store=s", "list"]
