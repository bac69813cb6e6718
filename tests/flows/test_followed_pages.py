"""Pages show commands and options that there are, and are followed word for word.

The tutorial and the notebook on a recording that takes seconds.
"""

import json
import re
import shlex
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import typer
from commands import call

import lidarpainter_models as lp
from flows.cli.main import GLOBAL_OPTIONS, app

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
PAGES = sorted([ROOT / "README.md", ROOT / "CONTRIBUTING.md", *DOCS.glob("*.md")])
TOP = typer.main.get_command(app)
SMALL = (
    *("--set", "observation.width_px=96", "--set", "rounds=1", "--set", "fit.steps=30"),
    *("--set", "refine.steps=10", "--set", 'novel.shifts=[{"lateral_m": 2}]'),
    *("--set", 'scoring.shifts=[{"lateral_m": 2}]'),
)
SET_UP = ("git", "make", ".")
"""Commands of the tutorial that make the environment that this test runs in."""


def commands_of(page):
    """Every command of a page's shell blocks; a trailing backslash joins lines."""
    blocks = re.findall(r"^```sh\n(.*?)^```$", page.read_text("utf-8"), re.MULTILINE | re.DOTALL)
    lines = [line for block in blocks for line in block.replace("\\\n", " ").splitlines()]
    return [words for line in lines if (words := shlex.split(line, comments=True))]


def shown_commands(page):
    """The words after `lidarpainter` in a page."""
    return [words[1:] for words in commands_of(page) if words[0].endswith("lidarpainter")]


def unknown_words(words):
    """What of a command's words there is not."""
    words = list(words)
    while words and words[0] in GLOBAL_OPTIONS:
        del words[:2]
    group = TOP
    while words and hasattr(group, "commands"):
        if words[0] not in group.commands:
            return [words[0]]
        group = group.commands[words.pop(0)]
    known = {name for one in group.params for name in (*one.opts, *one.secondary_opts)}
    options = {word.partition("=")[0] for word in words if word.startswith("--")}
    return sorted(options - known - {"--help"})


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_commands_of_a_page_are_there(page):
    found = {" ".join(words): unknown_words(words) for words in shown_commands(page)}
    assert {words: unknown for words, unknown in found.items() if unknown} == {}


def test_pages_show_commands():
    assert sum(len(shown_commands(page)) for page in PAGES) > 40


@pytest.mark.slow
def test_tutorial_ends_with_a_lane_aside(tmp_path, monkeypatch, prefect_api):  # noqa: ARG001
    from lidarpainter_models.viewing.viewer import LiveViewer

    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("LIDARPAINTER_STORE", raising=False)
    monkeypatch.setattr(LiveViewer, "play", lambda *_: None)  # else it plays until Ctrl-C
    monkeypatch.setattr("webbrowser.open", lambda _address: True)
    for words in commands_of(DOCS / "tutorial.md"):
        if words[0] in SET_UP:
            continue
        if words[0] == "python":
            smaller = ["6", "96"] if words[1].endswith("practice_log.py") else []
            script = [str(ROOT / words[1]), *words[2:], *smaller]
            subprocess.run([sys.executable, *script], check=True, capture_output=True)
            continue
        assert words[0] == "lidarpainter", words
        answer = call(*words[1:], *(SMALL if words[1] == "reconstruct" else ()))
        assert answer.code == 0, (words, answer.err)
    painted, plain = sorted(Path("aside").rglob("*.png")), Path("aside/unpainted")
    assert cv2.imread(str(painted[0])).std() > 10
    assert plain.is_dir()
    assert Path("overlay.png").stat().st_size > 1000
    assert "<title>LidarPainter: my-car/monday</title>" in Path("drive.html").read_text("utf-8")


@pytest.mark.slow
def test_notebook_runs_cell_by_cell(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    notebook = json.loads((DOCS / "examples/lane_aside.ipynb").read_text("utf-8"))
    names = {}
    for cell in notebook["cells"]:
        if cell["cell_type"] == "code":
            assert not cell["outputs"]
            source = "".join(cell["source"]).replace("= 320, 12, 150.0", "= 96, 4, 15.0")
            exec(compile(source, "lane_aside.ipynb", "exec"), names)  # noqa: S102 - our own page
    assert "held out: " in capsys.readouterr().out
    render, painted = np.split(cv2.imread("lane-aside/aside.png").astype(float), 2, axis=1)
    assert render.shape == (54, 96, 3)
    assert np.abs(render - painted).mean() > 1


def test_every_public_name_stands_in_the_reference():
    page = (DOCS / "api.md").read_text("utf-8")
    told = re.findall(r"^\.\. auto(?:function|class):: (\w+)$", page, re.MULTILINE)
    assert sorted(told) == sorted(lp.__all__)
