"""What the prose names is there."""

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
LIBRARY = "lidarpainter_models"
PACKAGES = ("flows", "tasks", "catalog", LIBRARY, "tests", "docs", "scripts")
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")])
HISTORY = {ROOT / "CHANGELOG.md", *(ROOT / "docs" / "log").glob("*.md")}
"""These pages name what was there."""
LINK = re.compile(r"\]\((?!https?://)([^)#\s]+)(?:#[^)\s]*)?\)")
ANCHOR = re.compile(r"\]\((?!https?://)([^)#\s]*)#([^)\s]+)\)")
HEADING = re.compile(r"^#+ (.*)$", re.MULTILINE)
NAMED = re.compile(r"`([\w./-]+)`")
QUESTION = re.compile(r"^\| (.+\?) \| `([\w./]+)` \| `(\w+)` \|$", re.MULTILINE)


def relative(page: Path) -> str:
    return str(page.relative_to(ROOT))


def path_of(name: str) -> Path:
    """A file that is named from the root, or from the library as its rooms are."""
    first = name.split("/")[0]
    return ROOT / name if first in PACKAGES or "/" not in name else ROOT / LIBRARY / name


@pytest.mark.parametrize("page", PAGES, ids=relative)
def test_every_link_leads_somewhere(page):
    links = LINK.findall(page.read_text("utf-8"))
    assert [link for link in links if not (page.parent / link).exists()] == []


def anchors_of(page: Path) -> set[str]:
    """What GitHub and the site call the headings of a page."""
    headings = HEADING.findall(page.read_text("utf-8"))
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", PAGES, ids=relative)
def test_every_anchor_is_a_heading(page):
    found = ANCHOR.findall(page.read_text("utf-8"))
    targets = [(page.parent / name if name else page, anchor) for name, anchor in found]
    pages = [(target, anchor) for target, anchor in targets if target.suffix == ".md"]
    assert [a for target, a in pages if a not in anchors_of(target)] == []


@pytest.mark.parametrize("page", [page for page in PAGES if page not in HISTORY], ids=relative)
def test_every_source_file_that_is_named_is_there(page):
    rooms = {path.name for path in (ROOT / LIBRARY).iterdir() if path.is_dir()}
    named = [
        name
        for name in NAMED.findall(page.read_text("utf-8"))
        if "/" in name and name.split("/")[0] in {*PACKAGES, *rooms}
    ]
    assert [name for name in named if not path_of(name).exists()] == []


def defined_in(path: Path) -> set[str]:
    """Classes, functions and constants at the top of a module."""
    found = set()
    for node in ast.parse(path.read_text("utf-8")).body:
        if isinstance(node, ast.Assign | ast.AnnAssign):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            found |= {target.id for target in targets if isinstance(target, ast.Name)}
        elif hasattr(node, "name"):
            found.add(node.name)
    return found


def test_twenty_questions_are_answered_where_the_page_says():
    page = (ROOT / "docs" / "architecture.md").read_text("utf-8")
    questions = QUESTION.findall(page)
    assert len(questions) == 20
    for question, file, name in questions:
        assert name in defined_in(path_of(file)), question


def said_in_code() -> str:
    """Every piece of text in the product's code; parts of an f-string are pieces of their own."""
    trees = [
        ast.parse(path.read_text("utf-8"))
        for package in ("flows", "tasks", "catalog", LIBRARY)
        for path in (ROOT / package).rglob("*.py")
    ]
    texts = [
        node.value
        for tree in trees
        for node in ast.walk(tree)
        if isinstance(node, ast.Constant) and isinstance(node.value, str)
    ]
    return "\0".join([*texts, (ROOT / "pyproject.toml").read_text("utf-8")])


def test_what_troubleshooting_quotes_is_what_the_code_prints():
    page = (ROOT / "docs" / "troubleshooting.md").read_text("utf-8")
    quoted = re.findall(r"^> `(.*)`$", page, re.MULTILINE)
    assert len(quoted) >= 20
    code = said_in_code()
    pieces = [piece for line in quoted for piece in line.split("…") if piece]
    assert [piece for piece in pieces if piece not in code] == []
