"""A command says soon that it begins, and what is mistyped costs no heavy import.

Budgets are in CPU seconds of a core that imports typer in `FLOOR_S`; a slower one gets as much
more, and every one twice as much.
"""

import functools
import json
import os
import resource
import subprocess
import sys

import psutil
import pytest
from terminals import ROOT, TerminalCommand

from catalog.store import open_store

FLOOR_S = 0.1
HELP_S, FIRST_OUTPUT_S, TYPO_S = 0.5, 1.0, 2.0
HEAVY = {"torch", "prefect", "numba", "scipy", "cv2", "zarr", "open3d"}
REPORT_IMPORTS = f"""
import sys
from flows.cli.main import main
code = main(sys.argv[1:])
print(*sorted({HEAVY} & set(sys.modules)))
sys.exit(code)
"""
RUN = {"run_id": "r1", "status": "complete", "artefacts": ["observations/a", "gaussians/b"]}
OUT = ("--out", "nowhere")


@pytest.fixture
def store(tmp_path):
    """A store that knows of one run and holds nothing of it."""
    store = open_store(tmp_path / "store")
    store.tables.merge("runs", [{**RUN, "scene_id": "a/b", "parameters": "{}", "result": "{}"}])
    return store


def cpu_s(*words):
    """CPU seconds of a Python with these words."""
    spent = [resource.getrusage(resource.RUSAGE_CHILDREN)]
    command = [sys.executable, *map(str, words)]
    answer = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, check=False)
    spent.append(resource.getrusage(resource.RUSAGE_CHILDREN))
    before, after = (one.ru_utime + one.ru_stime for one in spent)
    return after - before, answer


@functools.cache
def scale():
    """How much of a budget this machine gets."""
    seconds = min(cpu_s("-c", "import typer")[0] for _ in range(3))
    return 2 * max(1.0, seconds / FLOOR_S)


@pytest.mark.parametrize("command", [[], ["reconstruct"], ["painter", "train"]])
def test_help_is_fast_and_imports_nothing_heavy(command):
    seconds, answer = cpu_s("-c", REPORT_IMPORTS, *command, "--help")
    assert answer.stdout.splitlines()[-1] == ""
    assert seconds < HELP_S * scale()


@pytest.mark.parametrize(
    "words",
    [
        ["reconstruct", "a/b", "--set", "fit.stepz=3"],
        ["reconstruct", "a/b", "--preset", "perfect"],
        ["reconstruct", "a/b", "--shift", "2,x"],
        ["demo", "--set", "fit.steps=many"],
        ["render", "latest", "--trajectory", "latral:2", *OUT],
        ["render", "gone", "--trajectory", "lateral:2", *OUT],
        ["stylize", "latest", "--prompt", "night", "--frames", "5", *OUT],
        ["stylize", "latest", "--prompt", "foggy:2", *OUT],
        ["stylize", "latest", "--prompt", "foggy", "--visibility", "0", "--in-scene"],
        ["evaluate", "latest", "--protocol", "guess"],
        ["evaluate", "latest", "--previous", "mixed"],
        ["reconstruct", "a/b", "--painter", "picasso"],
        ["stylize", "latest", "--prompt", "snowy", *OUT],
        ["ingest", "pandasett", "nowhere"],
        ["painter", "info", "--painter", "picasso"],
    ],
)
def test_what_is_mistyped_imports_nothing_heavy(words, store):
    seconds, answer = cpu_s("-c", REPORT_IMPORTS, "--store", store.root, *words)
    assert answer.returncode == 2
    assert answer.stderr.count("\n") == 1
    assert answer.stdout.splitlines()[-1] == ""
    assert seconds < TYPO_S * scale() / 2


@pytest.mark.parametrize(
    "words",
    [
        ["painter", "train", "--seeds", "1000", "--set", "training.stepz=3"],
        ["painter", "harvest", "--seeds", "1000", "--set", "harvest.sed=3"],
    ],
)
def test_a_wrong_setting_of_a_training_is_refused_soon(words, store):
    """The settings of a training lie beside its networks, which need torch."""
    spent, torch_alone = [], []
    for _ in range(2):  # in turns: another job on these cores may double either
        seconds, answer = cpu_s("-m", "flows.cli", "--store", store.root, *words)
        spent.append(seconds)
        torch_alone.append(cpu_s("-c", "import torch")[0])
        assert answer.returncode == 2
        assert answer.stderr.count("\n") == 1
    assert min(spent) < 2 * min(torch_alone)


@pytest.mark.parametrize(
    "words",
    [
        ["reconstruct", "a/b"],
        ["demo", *OUT],
        ["doctor"],
        ["ingest", "pandaset", "nowhere"],
        ["render", "latest", "--trajectory", "lateral:2", *OUT],
        ["stylize", "latest", "--prompt", "night", *OUT],
        ["evaluate", "latest"],
        ["painter", "train", "--seeds", "1000"],
        ["painter", "harvest", "--seeds", "1000"],
        ["painter", "evaluate", "--painter", "nano", "--pairs", "nowhere"],
        ["painter", "info"],
        ["painter", "benchmark"],
    ],
)
def test_a_command_says_soon_that_it_begins(words, store, tmp_path):
    command = TerminalCommand("--store", store.root, *words, PREFECT_HOME=str(tmp_path))
    command.wait_for(r"\S", timeout_s=60)
    spent = psutil.Process(command.process.pid).cpu_times()
    command.process.kill()
    command.finish()
    assert spent.user + spent.system < FIRST_OUTPUT_S * scale()


@pytest.mark.parametrize("table", ["runs", "scenes"])
def test_a_table_is_there_as_soon(table, store):
    seconds, answer = cpu_s("-m", "flows.cli", "--store", store.root, "catalog", "list", table)
    assert table in answer.stdout
    assert seconds < FIRST_OUTPUT_S * scale()


def test_words_that_begin_are_shown_on_a_terminal_alone(store):
    words = ["--store", store.root, "reconstruct", "a/b"]
    assert "opening a/b" not in cpu_s("-m", "flows.cli", *words)[1].stderr
    command = TerminalCommand(*words)
    assert command.finish() == 2
    assert command.shown.strip().startswith("opening a/b ...")
    assert "lidarpainter: no scene a/b in" in command.shown


@pytest.mark.parametrize(
    "encoding",
    [{"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}, {"PYTHONIOENCODING": "ascii"}],
    ids=["C locale", "ASCII stdout"],
)
def test_a_path_beyond_ascii_is_read_and_told_whatever_the_locale_is(encoding, tmp_path):
    store = open_store(tmp_path / "köln-通り")
    store.tables.merge("runs", [{**RUN, "scene_id": "a/b", "parameters": "{}", "result": "{}"}])
    words = ["-m", "flows.cli", "--store", str(store.root), "catalog", "list", "runs", "--json"]
    answer = subprocess.run(
        [sys.executable, *words],
        capture_output=True,
        cwd=ROOT,
        env=os.environ | encoding,
        check=True,
    )
    assert json.loads(answer.stdout)["store"] == str(store.root)
