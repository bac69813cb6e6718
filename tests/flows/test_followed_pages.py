"""The tutorial and the notebook, followed word for word on a recording that takes seconds."""

import json
import re
import shlex
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from commands import call

import lidarpainter_models as lp

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
SMALL = (
    *("--set", "observation.width_px=96", "--set", "rounds=1", "--set", "fit.steps=30"),
    *("--set", "refine.steps=10", "--set", 'novel.shifts=[{"lateral_m": 2}]'),
    *("--set", 'scoring.shifts=[{"lateral_m": 2}]'),
)
SET_UP = ("git", "make", ".")
"""Commands of the tutorial that make the environment that this test runs in."""


def commands_of(page):
    """Every command of a page's shell blocks, comments left out."""
    blocks = re.findall(r"^```sh\n(.*?)^```$", page.read_text("utf-8"), re.MULTILINE | re.DOTALL)
    lines = [line for block in blocks for line in block.splitlines()]
    return [words for line in lines if (words := shlex.split(line, comments=True))]


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
