"""The command ends as it promises: codes, one line, and JSON alone on stdout."""

import json

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


def test_global_options_may_stand_anywhere():
    words = ["ingest", "a", "--store", "s", "b", "--debug", "--", "--store"]
    assert globals_first(words) == ["--store", "s", "--debug", "ingest", "a", "b", "--", "--store"]
    assert globals_first(["list", "--store=s"]) == ["--store=s", "list"]
