"""Ctrl-C and SIGTERM end every command soon, in one line, with nothing left; then it goes on."""

import shutil
import signal

import psutil
import pytest
from commands import SMALL_TRAINING, settings
from process_ends import still_running
from random_pairs import write_pairs
from small_pandaset import PandasetFolder
from terminals import TerminalCommand
from tiny_street import SCENE, SETTINGS

from catalog.store import open_store
from flows.interruption import MESSAGE

LONGEST_S = 2.0
CODES = {signal.SIGINT: 130, signal.SIGTERM: 143}


def reconstruction(*changes):
    return ["reconstruct", SCENE, *settings(*SETTINGS, *changes)]


def ingestion(folder):
    log = PandasetFolder(folder / "pandaset", num_frames=12)
    log.write_log()
    return ["ingest", "pandaset", log.root]


def training(folder):
    write_pairs(folder / "pairs", range(8))
    return ["painter", "train", "--pairs", folder / "pairs", "--steps", "60", *SMALL_TRAINING]


def rendering(folder):
    where = ("--trajectory", "lateral:1+up:0.5", "--postpaint", "--out", folder / "images")
    return ["render", "latest", *where]


COMMANDS = {
    "ingest": (ingestion, "ingest"),
    "prepare": (lambda _: reconstruction("observation.width_px=80"), "prepare"),
    "fit": (lambda _: reconstruction("fit.steps=600"), r"fit .*Gaussians"),
    "paint": (lambda _: reconstruction("fit.steps=41"), "paint-1"),
    "evaluate": (lambda _: ["evaluate", "latest", "--postpaint"], "paper-"),
    "render": (rendering, "render"),
    "train": (training, "train .*step"),
}
"""By stage: the command, and what is shown once the stage has begun."""
EVERY_CHANGE = {("render", signal.SIGTERM)}
"""Tested with every change; a command takes seconds to begin."""
CASES = [
    pytest.param(
        *case,
        marks=() if case in EVERY_CHANGE else pytest.mark.slow,
        id=f"{case[0]}-{case[1].name}",
    )
    for case in ((stage, number) for stage in COMMANDS for number in CODES)
]


@pytest.fixture
def store(tiny_run, tmp_path):
    """A store of its own that holds the tiny street and its run."""
    shutil.copytree(tiny_run.store.root, tmp_path / "store")
    return open_store(tmp_path / "store")


@pytest.fixture
def begin(store, tmp_path, monkeypatch):
    """Starts a command on a terminal, against a Prefect server of its own."""
    monkeypatch.delenv("PREFECT_API_URL", raising=False)

    def start(words):
        return TerminalCommand(
            "--store", store.root, *words, PREFECT_HOME=str(tmp_path / "prefect")
        )

    return start


@pytest.mark.parametrize(("stage", "number"), CASES)
def test_a_signal_ends_the_command_soon_and_it_goes_on(stage, number, begin, store, tmp_path):
    make, shown = COMMANDS[stage]
    words = make(tmp_path)
    known = statuses(store)
    command = begin(words)
    command.wait_for(shown)
    started = psutil.Process(command.process.pid).children(recursive=True)
    assert command.interrupt(number) < LONGEST_S, command.shown
    assert command.process.returncode == CODES[number]
    assert command.shown.count(MESSAGE) == 1
    assert command.shown.rstrip().endswith(MESSAGE)
    assert "Traceback" not in command.shown
    assert still_running(started) == []
    if words[0] == "reconstruct":
        assert started  # the server at least
        assert statuses(store) == sorted([*known, "interrupted"])
    again = begin(words)
    assert again.finish() == 0, again.shown
    assert "interrupted" not in statuses(store)


def statuses(store):
    """As they are entered: other tests have left runs of their own."""
    return sorted(row["status"] for row in store.tables.rows("runs"))


ENTERS_FOR_EVER = """
import sys, time
from flows import interruption
interruption.LATE_S = 0.3
interruption.watch()
with interruption.at_interruption(lambda: time.sleep(3600)):
    print("begun", file=sys.stderr, flush=True)
    time.sleep(3600)
"""


def test_what_cannot_be_entered_does_not_hold_up_the_end():
    command = TerminalCommand(code=ENTERS_FOR_EVER)
    command.wait_for("begun")
    assert command.interrupt(signal.SIGTERM) < LONGEST_S
    assert command.process.returncode == CODES[signal.SIGTERM]


WORKER = """
import sys
from pathlib import Path
from flows.environment import prepare_environment
prepare_environment()
from flows.cli.progress import shown_progress
from flows.reconstruct import reconstruct_scene
from flows.server import prefect_server

with prefect_server(Path(sys.argv[1]) / "server.log"), shown_progress():
    reconstruct_scene(sys.argv[2], settings=tuple(sys.argv[3:]), store=sys.argv[1])
"""


@pytest.mark.slow
def test_a_flow_of_a_worker_is_entered_as_interrupted(store, tmp_path, monkeypatch):
    monkeypatch.delenv("PREFECT_API_URL", raising=False)
    words = [store.root, SCENE, *SETTINGS, "fit.steps=600"]
    flow = TerminalCommand(*words, code=WORKER, PREFECT_HOME=str(tmp_path / "prefect"))
    flow.wait_for("fit .*Gaussians")
    flow.interrupt(signal.SIGTERM)
    assert flow.process.returncode == -signal.SIGTERM
    assert sorted(row["status"] for row in store.tables.rows("runs")) == ["complete", "interrupted"]
