"""Every command that a page shows is one that `lidarpainter` has, with options that it knows."""

import re
import shlex
from pathlib import Path

import pytest
import typer

from flows.cli.main import GLOBAL_OPTIONS, app

ROOT = Path(__file__).resolve().parents[2]
PAGES = sorted([ROOT / "README.md", ROOT / "CONTRIBUTING.md", *(ROOT / "docs").glob("*.md")])
TOP = typer.main.get_command(app)


def shown_commands(page):
    """The words after `lidarpainter` in a page's shell blocks; a trailing backslash joins lines."""
    blocks = re.findall(r"^```sh\n(.*?)^```$", page.read_text("utf-8"), re.MULTILINE | re.DOTALL)
    lines = [line for block in blocks for line in block.replace("\\\n", " ").splitlines()]
    called = [shlex.split(line, comments=True) for line in lines if "lidarpainter " in line]
    return [words[1:] for words in called if words and words[0].endswith("lidarpainter")]


def unknown_words(words):
    """What of a command's words there is not."""
    words = list(words)
    while words and words[0] in GLOBAL_OPTIONS:
        del words[:2]
    group = TOP
    while words and hasattr(group, "commands"):
        if words[0] not in group.commands:
            return [words[0]]
        group = group.commands[words.pop(0)]
    known = {name for one in group.params for name in (*one.opts, *one.secondary_opts)}
    options = {word.partition("=")[0] for word in words if word.startswith("--")}
    return sorted(options - known - {"--help"})


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_commands_of_a_page_are_there(page):
    found = {" ".join(words): unknown_words(words) for words in shown_commands(page)}
    assert {words: unknown for words, unknown in found.items() if unknown} == {}


def test_pages_show_commands():
    assert sum(len(shown_commands(page)) for page in PAGES) > 40
