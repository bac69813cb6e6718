"""The rules of the house, held as tests."""

import ast
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = ("flows", "tasks", "catalog", "lidarpainter_models")
SOURCES = sorted(path for package in PACKAGES for path in (ROOT / package).rglob("*.py"))
LAZY = {"open3d", "diffusers", "transformers", "peft", "gsplat"}
MAX_LINES = 350


def relative(path: Path) -> str:
    return str(path.relative_to(ROOT))


def top_level_imports(tree: ast.Module) -> set[str]:
    names = set()
    for node in tree.body:
        if isinstance(node, ast.Import):
            names |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            names.add(node.module.split(".")[0])
    return names


@pytest.mark.parametrize("path", SOURCES, ids=relative)
def test_module_is_short_documented_and_imports_heavy_things_late(path):
    text = path.read_text("utf-8")
    tree = ast.parse(text)
    assert ast.get_docstring(tree), "a module says what it does"
    assert len(text.splitlines()) <= MAX_LINES, "a reader cannot hold it in mind"
    assert not top_level_imports(tree) & LAZY, "heavy packages are imported inside functions"


def test_no_module_is_named_for_nothing():
    forbidden = re.compile(r"(utils?|misc|helpers?|common)\.py$")
    assert [relative(path) for path in SOURCES if forbidden.search(path.name)] == []


def test_library_keeps_its_hands_still():
    """No environment variables and no printing inside the library."""
    offenders = [
        relative(path)
        for path in SOURCES
        if path.is_relative_to(ROOT / "lidarpainter_models")
        and re.search(r"os\.environ|getenv|^\s*print\(", path.read_text("utf-8"), re.MULTILINE)
    ]
    assert offenders == []


def test_import_contracts_hold():
    result = subprocess.run(
        [Path(sys.executable).parent / "lint-imports", "--no-cache"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert result.returncode == 0, result.stdout


def test_no_dependency_is_unpinned():
    """Every requirement of the project stands in constraints.txt."""
    import tomllib

    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    extras = project["optional-dependencies"]
    wanted = {
        re.match(r"[A-Za-z0-9_-]+", requirement)[0].lower()
        for requirement in project["dependencies"] + extras["dev"] + extras["diffusion"]
        if not requirement.startswith(project["name"])
    }
    pinned = {
        line.split("==")[0].lower()
        for line in (ROOT / "constraints.txt").read_text("utf-8").splitlines()
        if "==" in line
    }
    assert wanted - pinned == set()
