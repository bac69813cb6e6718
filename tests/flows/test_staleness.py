"""What a change of the source computes anew, seen by commands on a copy of the whole project.

What makes which stage stale is held by `tests/tasks/test_stage_code.py`.
"""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from small_pandaset import PandasetFolder

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = ("flows", "tasks", "catalog", "lidarpainter_models")

pytestmark = pytest.mark.slow


class Project:
    """A copy of the source that can be changed, and a store of its own."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.store = folder, folder / "store"
        for package in PACKAGES:
            shutil.copytree(ROOT / package, folder / package, ignore=skipped)

    def answer(self, *words: object) -> dict[str, Any]:
        """What a command prints as JSON."""
        command = ["--store", str(self.store), *map(str, words), "--json"]
        environment = {
            **os.environ,
            "PYTHONPATH": str(self.folder),
            "PREFECT_HOME": str(self.folder / "prefect"),
            "NUMBA_CACHE_DIR": str(self.folder / "compiled"),
        }
        environment.pop("PREFECT_API_URL", None)
        answer = subprocess.run(
            [sys.executable, "-m", "flows.cli", *command],
            cwd=self.folder,
            env=environment,
            capture_output=True,
            text=True,
            check=False,
        )
        assert answer.returncode == 0, answer.stderr
        return json.loads(answer.stdout)

    def change(self, name: str, old: str, new: str) -> None:
        """Write one expression of a file differently."""
        path = self.folder / name
        text = path.read_text("utf-8")
        assert old in text
        path.write_text(text.replace(old, new, 1), "utf-8")


def skipped(_folder: str, names: list[str]) -> list[str]:
    return [name for name in names if name == "__pycache__"]


NIGHT = """
name = "night"
painter = "none"
publish = []
set = [
    "observation.width_px=64", "rounds=1", "fit.steps=6", "refine.steps=4",
    "fit.initialisation.num_gaussians=300", "fit.densification.budget=400",
    "refine.densification.budget=400",
]
[[source]]
dataset = "pandaset"
root = "logs"
cameras = ["front_camera"]
[budget]
free_disk_gb = 0
"""
LOSS = "lidarpainter_models/gaussians/fitting/refinement.py"


class Fleet:
    """A fleet of two short logs, made by a copy of the project."""

    def __init__(self, folder: Path) -> None:
        self.project = Project(folder)
        self.manifest = folder / "night.toml"
        self.manifest.write_text(NIGHT)
        for sequence in ("001", "002"):
            PandasetFolder(folder / "logs", sequence).write_log()

    def run(self, *words: str) -> list[tuple[str, str, int]]:
        """Scene, run and number of attempts of every sequence after `fleet run`."""
        found = self.project.answer("fleet", "run", self.manifest, *words)["sequences"]
        assert [one["state"] for one in found] == ["done", "done"]
        return [(one["scene"], one["run_id"], one["attempts"]) for one in found]

    def made(self) -> dict[str, int]:
        """How many artefacts there are of each kind, and when scenes were written."""
        root = self.project.store
        counts = {one.name: len(list(one.iterdir())) for one in (root / "artefacts").iterdir()}
        scenes = (root / "scenes/pandaset").glob("*/manifest.json")
        return counts | {one.parent.name: one.stat().st_mtime_ns for one in scenes}


def test_one_changed_line_in_a_loss_redoes_fits_and_what_follows_but_not_ingest(tmp_path):
    fleet = Fleet(tmp_path)
    first = fleet.run()
    before = fleet.made()
    assert before["observations"] == 2
    answer = fleet.project.answer
    assert answer("catalog", "stale")["runs"] == []
    fleet.project.change(LOSS, "(tangents / unit)", "(tangents / (1 * unit))")
    stale = answer("catalog", "stale")
    assert stale["scenes"] == 2
    assert stale["total"]["cpu_seconds"] > 0
    for one in stale["runs"]:
        assert {name.partition("/")[0] for name in one["artefacts"]} == {"gaussians"}
        assert one["changed"] == ["lidarpainter_models.gaussians.fitting.refinement"]
    told = answer("catalog", "explain", first[0][1])
    stages = {name.partition("/")[0]: one for name, one in told["inputs"].items()}
    assert stages["gaussians"]["is_stale"]
    assert "fitting.refinement" in stages["gaussians"]["stale"][0]
    assert not stages["observations"]["is_stale"]
    assert fleet.run("--accept-stale") == first
    assert fleet.made() == before
    again = fleet.run()
    assert [scene for scene, _, _ in again] == [scene for scene, _, _ in first]
    assert {run for _, run, _ in again}.isdisjoint(run for _, run, _ in first)
    assert [attempts for _, _, attempts in again] == [2, 2]
    assert fleet.made() == before | {"gaussians": 2 * before["gaussians"]}
    assert answer("catalog", "stale")["runs"] == []
