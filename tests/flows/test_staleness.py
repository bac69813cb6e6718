"""What a change of the source computes anew, seen by the command: on a copy of the whole project.

The same `reconstruct` runs from the copy after each change; `computed_now` says what it did.
"""

import json
import os
import shutil
import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from small_pandaset import PandasetFolder
from toy_store import SMALL, TOY_SCENE, write_toy_scene

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = ("flows", "tasks", "catalog", "lidarpainter_models")
SETTINGS = (*SMALL, "rounds=1")
JUDGED = {"evaluate-unpainted", "evaluate", "envelope"}
FIT_AND_AFTER = {"fit", "paint-1", "refine-1", *JUDGED, "report"}
STAGES = {"prepare", "examine", *FIT_AND_AFTER}

pytestmark = pytest.mark.slow


class Project:
    """A copy of the source that can be changed, and a store it has reconstructed a street in."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.store = folder, folder / "store"
        for package in PACKAGES:
            shutil.copytree(ROOT / package, folder / package, ignore=skipped)
        write_toy_scene(self.store)

    def computed(self) -> set[str]:
        """The stages that the same command computes now."""
        assignments = [word for setting in SETTINGS for word in ("--set", setting)]
        found = self.answer("reconstruct", TOY_SCENE, *assignments)["computed_now"]
        assert set(found) == STAGES
        return {stage for stage, is_new in found.items() if is_new}

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

    def sources(self) -> list[Path]:
        return [path for package in PACKAGES for path in (self.folder / package).rglob("*.py")]

    @contextmanager
    def changed(self, paths, change):
        """The files as `change` makes them; afterwards as they were, times included."""
        before = {path: (path.read_text("utf-8"), path.stat()) for path in paths}
        for path, (text, _) in before.items():
            assert change(text) != text, path
            path.write_text(change(text), "utf-8")
        try:
            yield
        finally:
            for path, (text, status) in before.items():
                path.write_text(text, "utf-8")
                os.utime(path, ns=(status.st_atime_ns, status.st_mtime_ns))

    def computed_after(self, module: str, old: str, new: str) -> set[str]:
        """What is computed when one expression of a module is written differently."""
        path = self.folder.joinpath(*module.split(".")).with_suffix(".py")
        with self.changed([path], lambda text: text.replace(old, new, 1)):
            return self.computed()


def skipped(_folder: str, names: list[str]) -> list[str]:
    return [name for name in names if name == "__pycache__"]


@pytest.fixture(scope="module")
def project(tmp_path_factory):
    made = Project(tmp_path_factory.mktemp("project"))
    assert made.computed() == STAGES
    assert made.computed() == set()
    return made


def test_a_comment_in_every_file_computes_nothing(project):
    with project.changed(project.sources(), lambda text: f"{text}# one comment\n"):
        assert project.computed() == set()


def test_scoring_code_computes_evaluation_and_report_and_nothing_else(project):
    computed = project.computed_after(
        "lidarpainter_models.evaluation.scene_evaluation", "sum(weights)", "sum(weights[:])"
    )
    assert computed == {"evaluate-unpainted", "evaluate", "report"}


def test_the_rasteriser_computes_the_fit_and_all_after_it(project):
    computed = project.computed_after(
        "lidarpainter_models.kernels.gaussian_raster.cpu", "return ", "return None or "
    )
    assert computed == FIT_AND_AFTER


def test_a_reader_computes_nothing_of_a_stored_scene(project):
    for reader in ("pandaset.reader", "waymo.v1", "nuscenes.reader", "canonical.reader"):
        computed = project.computed_after(
            f"lidarpainter_models.readers.{reader}", "return ", "return None or "
        )
        assert computed == set(), reader


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
    change = ("(tangents / unit)", "(tangents / (1 * unit))")
    with fleet.project.changed([tmp_path / LOSS], lambda text: text.replace(*change, 1)):
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
