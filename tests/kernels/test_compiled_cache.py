"""Compiled kernels from an install that nobody may write to.

A file where a cache folder would be keeps even the superuser from writing there.
"""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
BLEND_ONE_POINT = """
import torch
from lidarpainter_models.kernels.point_blend import blend_points, cpu
mean, total = blend_points(torch.tensor([[1.5, 1.5]]), torch.ones(1), torch.full((1, 1), 3.0),
    torch.ones(3, 3), weight=torch.ones(1), radius_px=torch.ones(1))
assert float(mean[1, 1, 0]) == 3.0
print(cpu.__file__, sum(cpu._scatter.stats.cache_hits.values()))
"""
PREPARED = "from flows.environment import prepare_environment\nprepare_environment()\n"


@pytest.fixture(scope="module")
def read_only_install(tmp_path_factory):
    """A copy of the packages in which every `__pycache__` is taken."""
    folder = tmp_path_factory.mktemp("install")
    for package in ("lidarpainter_models", "flows"):
        shutil.copytree(
            ROOT / package, folder / package, ignore=shutil.ignore_patterns("__pycache__")
        )
    for inner in [path for path in folder.rglob("*") if path.is_dir()]:
        (inner / "__pycache__").write_text("")
        inner.chmod(0o555)
    yield folder
    for inner in [path for path in folder.rglob("*") if path.is_dir()]:
        inner.chmod(0o755)


def blend_in(install, home, *, code=BLEND_ONE_POINT):
    """Run the point blend of an install in a process of its own: file of the module, cache hits."""
    environment = {
        name: value
        for name, value in os.environ.items()
        if name not in ("NUMBA_CACHE_DIR", "XDG_CACHE_HOME", "PYTHONPATH")
    }
    environment |= {"HOME": str(home), "PYTHONDONTWRITEBYTECODE": "1", "TMPDIR": str(home.parent)}
    told = subprocess.run(
        [sys.executable, "-c", code],
        cwd=install,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert told.returncode == 0, told.stderr
    module, hits = told.stdout.split()
    assert module.startswith(str(install))
    return int(hits)


@pytest.mark.slow
def test_read_only_install_keeps_compiled_code_in_the_users_cache(read_only_install, tmp_path):
    home = tmp_path / "home"
    home.mkdir()
    assert blend_in(read_only_install, home) == 0
    assert list((home / ".cache").rglob("*.nbc"))
    assert blend_in(read_only_install, home) == 1


@pytest.mark.slow
def test_without_any_place_to_write_the_prepared_command_still_compiles(
    read_only_install, tmp_path
):
    home = tmp_path / "home"
    home.write_text("")  # not a folder
    assert blend_in(read_only_install, home, code=PREPARED + BLEND_ONE_POINT) == 0
    assert list(tmp_path.glob("lidarpainter-numba-*"))
