"""The rules of the house, held as tests."""

import ast
import re
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = ("flows", "tasks", "catalog", "lidarpainter_models")
SOURCES = sorted(path for package in PACKAGES for path in (ROOT / package).rglob("*.py"))
LAZY = {"open3d", "diffusers", "transformers", "peft", "gsplat", "gsply", "grpc", "pxr", "av"}
LAZY |= {"ncore", "upath"}
MAX_LINES = 350
MAX_FUNCTION_LINES = 60
WHOLE = ("bags", "dev", "diffusion", "docs", "export", "ncore", "simulators")
"""Extras that a checkout has."""
COMPILED = ("lidarpainter_models/kernels/", "lidarpainter_models/synthetic/raytracing/")
"""A compiled loop may stand in one long function."""


def relative(path: Path) -> str:
    return str(path.relative_to(ROOT))


@cache
def parsed(path: Path) -> ast.Module:
    return ast.parse(path.read_text("utf-8"))


def top_level_imports(tree: ast.Module) -> set[str]:
    names = set()
    for node in tree.body:
        if isinstance(node, ast.Import):
            names |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            names.add(node.module.split(".")[0])
    return names


def test_modules_are_short_documented_and_import_heavy_things_late():
    for path in SOURCES:
        text, tree = path.read_text("utf-8"), parsed(path)
        assert ast.get_docstring(tree), f"{relative(path)} does not say what it does"
        assert len(text.splitlines()) <= MAX_LINES, f"nobody can hold {relative(path)} in mind"
        assert not top_level_imports(tree) & LAZY, f"{relative(path)} imports heavy things early"


def test_no_function_is_longer_than_a_screen():
    long = {
        f"{relative(path)}: {node.name}": lines
        for path in SOURCES
        if not relative(path).startswith(COMPILED)
        for node in ast.walk(parsed(path))
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
        and (lines := node.end_lineno - first_line(node) + 1) > MAX_FUNCTION_LINES
    }
    assert long == {}


def first_line(function: ast.FunctionDef | ast.AsyncFunctionDef) -> int:
    """Where it begins, decorators included."""
    return min([function.lineno, *(decorator.lineno for decorator in function.decorator_list)])


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


def test_compiled_code_lives_with_the_kernels():
    """And in the synthetic street's ray tracer, which nothing else uses."""
    homes = [ROOT / "lidarpainter_models" / name for name in ("kernels", "synthetic/raytracing")]
    offenders = [
        relative(path)
        for path in SOURCES
        if re.search(r"^\s*(import|from) numba\b", path.read_text("utf-8"), re.MULTILINE)
        and not any(path.is_relative_to(home) for home in homes)
    ]
    assert offenders == []


def test_kernels_are_asked_at_their_doors():
    """Backends are chosen by the door of a kernel, nowhere else in the library."""
    kernels = ROOT / "lidarpainter_models" / "kernels"
    inside = re.compile(r"kernels\.\w+(\.(cpu|cuda)\b| import .*\b(cpu|cuda)\b)")
    offenders = [
        relative(path)
        for path in SOURCES
        if not path.is_relative_to(kernels) and inside.search(path.read_text("utf-8"))
    ]
    assert offenders == []


@pytest.mark.parametrize(
    "kernel",
    [path.parent for path in SOURCES if path.name == "cpu.py"],
    ids=lambda folder: folder.name,
)
def test_every_kernel_has_its_plain_reference(kernel):
    assert (kernel / "reference.py").is_file()


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
    requirements = sum((extras[extra] for extra in WHOLE), project["dependencies"])
    wanted = {
        re.match(r"[A-Za-z0-9_-]+", requirement)[0].lower()
        for requirement in requirements
        if not requirement.startswith(project["name"])
    }
    pinned = {
        line.split("==")[0].lower()
        for line in (ROOT / "constraints.txt").read_text("utf-8").splitlines()
        if "==" in line
    }
    assert wanted - pinned == set()
