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

import pytest
from toy_store import SMALL, TOY_SCENE, write_toy_scene

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = ("flows", "tasks", "catalog", "lidarpainter_models")
SETTINGS = (*SMALL, "rounds=1")
FIT_AND_AFTER = {"fit", "paint-1", "refine-1", "evaluate-unpainted", "evaluate", "report"}
STAGES = {"prepare", *FIT_AND_AFTER}

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
        command = ["--store", str(self.store), "reconstruct", TOY_SCENE, "--json", *assignments]
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
        found = json.loads(answer.stdout)["computed_now"]
        assert set(found) == STAGES
        return {stage for stage, is_new in found.items() if is_new}

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
        "lidarpainter_models.evaluation.judging", "sum(weights)", "sum(weights[:])"
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
