"""Check shapes while testing, and find the real log where there is one.

The jaxtyping hook rewrites functions, which numba cannot compile: modules that hold numba code are
left out of it.
"""

import os
from pathlib import Path

import pytest
from hypothesis import settings
from jaxtyping import install_import_hook

from flows.environment import THREADS

for _name, _value in THREADS.items():
    os.environ.setdefault(_name, _value)  # read when a test first imports numba

ROOT = Path(__file__).resolve().parents[1]
SHARED_ENVIRONMENT = "LIDARPAINTER_SHARED"

settings.register_profile("shared machine", deadline=None)  # time says nothing on a busy core
settings.load_profile("shared machine")


def checked_modules() -> list[str]:
    """Every library module whose annotations can be checked at run time."""
    paths = sorted((ROOT / "lidarpainter_models").rglob("*.py"))
    return [
        ".".join(path.relative_to(ROOT).with_suffix("").parts)
        for path in paths
        if path.name != "__init__.py" and "import numba" not in path.read_text("utf-8")
    ]


install_import_hook(checked_modules(), "shape_checking.check")

pytest_plugins = ["board_world", "small_pandaset"]  # fixtures that several rooms share


@pytest.fixture(scope="session")
def shared_folder() -> Path:
    """The folder with real logs and small public networks; tests skip where it is absent."""
    folder = Path(os.environ.get(SHARED_ENVIRONMENT, ROOT.parent / "shared"))
    if not (folder / "data").is_dir():
        pytest.skip(f"no real data at {folder} (set {SHARED_ENVIRONMENT})")
    return folder
