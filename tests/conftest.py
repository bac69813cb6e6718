"""Check shapes while testing, and find the real log where there is one.

The jaxtyping hook rewrites functions, which numba and Triton cannot compile: modules that hold such
code are left out of it, and so are textures, whose small functions a street calls 200,000 times.
Without a GPU, Triton's kernels run in its interpreter.
"""

import os
import re
import shutil
import tempfile
from collections.abc import Iterator
from functools import lru_cache, partial
from importlib import import_module
from pathlib import Path

import pytest
from hypothesis import settings
from jaxtyping import config, install_import_hook

from flows.environment import THREADS

for _name, _value in THREADS.items():
    os.environ.setdefault(_name, _value)  # read when a test first imports numba

if not import_module("torch").cuda.is_available():  # not before the threads are set
    os.environ.setdefault("TRITON_INTERPRET", "1")  # read when its kernels are first imported

ROOT = Path(__file__).resolve().parents[1]
SHARED_ENVIRONMENT = "LIDARPAINTER_SHARED"
FOLDER = "LIDARPAINTER_DRAWN_STREETS"
"""Where the streets lie that tests have drawn (`drawn_streets`)."""

settings.register_profile("shared machine", deadline=None)  # time says nothing on a busy core
settings.load_profile("shared machine")


def checked_modules() -> frozenset[str]:
    """Every library module and package whose annotations can be checked at run time."""
    paths = (ROOT / "lidarpainter_models").rglob("*.py")
    return frozenset(
        ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")
        for path in paths
        if path.parent.name != "textures"
        and not re.search(r"^import (numba|triton)\b", path.read_text("utf-8"), re.MULTILINE)
    )


# the hook takes a package's name for all that is below it, numba code included
_finder = install_import_hook([], "shape_checking.check").hook
_finder.should_instrument = checked_modules().__contains__

# fixtures that several rooms share
pytest_plugins = ["board_world", "bucket_stand_in", "small_pandaset"]


@pytest.fixture(scope="session")
def shared_folder() -> Path:
    """The folder with real logs and small public networks; tests skip where it is absent."""
    folder = Path(os.environ.get(SHARED_ENVIRONMENT, ROOT.parent / "shared"))
    if not (folder / "data").is_dir():
        pytest.skip(f"no real data at {folder} (set {SHARED_ENVIRONMENT})")
    return folder


def pytest_configure(config: pytest.Config) -> None:
    """Make the folder of drawn streets, for this process and its workers."""
    if not hasattr(config, "workerinput"):
        os.environ[FOLDER] = tempfile.mkdtemp(prefix="drawn-streets-")
        config.add_cleanup(partial(shutil.rmtree, os.environ[FOLDER]))


@pytest.fixture(scope="session", autouse=True)
def _streets_drawn_once() -> None:
    """Read a street that any worker of this test run has drawn."""
    from drawn_streets import kept_city

    from lidarpainter_models.synthetic import street

    street._city = lru_cache(maxsize=2)(kept_city)


@pytest.fixture(autouse=True)
def _own_refusals(request: pytest.FixtureRequest) -> Iterator[None]:
    """Users run without the checker: what a test says is refused, the library refuses itself."""
    config.update("jaxtyping_disable", "refused" in request.node.name)
    yield
    config.update("jaxtyping_disable", False)
