"""Every command's help has an example, and the examples are words that the command knows."""

import shlex

import pytest
import typer
from commands import succeed

from flows.cli.main import app


def commands(group, *path):
    """Every command below a group, by the words that call it."""
    found = {}
    for name, one in group.commands.items():
        if hasattr(one, "commands"):
            found |= commands(one, *path, name)
        else:
            found[(*path, name)] = one
    return found


COMMANDS = commands(typer.main.get_command(app))


def examples(command):
    """The lines that call the command, without its name."""
    lines = (line.strip().partition("lidarpainter ") for line in command.help.splitlines())
    return [shlex.split(words) for before, found, words in lines if found]


def test_there_are_commands():
    assert len(COMMANDS) > 15
    assert ("catalog", "delete") in COMMANDS


@pytest.mark.parametrize("path", COMMANDS, ids=" ".join)
def test_help_has_an_example_of_known_words(path):
    found = examples(COMMANDS[path])
    assert [words for words in found if tuple(words[: len(path)]) == path]
    for words in found:
        called = next(COMMANDS[name] for name in COMMANDS if tuple(words[: len(name)]) == name)
        known = {name for parameter in called.params for name in parameter.opts}
        assert {word for word in words if word.startswith("--")} <= known


@pytest.mark.parametrize("path", COMMANDS, ids=" ".join)
def test_every_option_says_what_it_is(path):
    assert [one.name for one in COMMANDS[path].params if not one.help] == []
    assert "Example" in succeed(*path, "--help").out


@pytest.mark.parametrize(
    ("path", "expected"),
    [
        (("render",), "left is positive"),
        (("reconstruct",), "Metres to both sides"),
        (("stylize",), "pixels"),
        (("painter", "train"), "CPU seconds"),
    ],
)
def test_units_and_signs_are_said(path, expected):
    text = " ".join(str(one.help) for one in COMMANDS[path].params)
    assert expected in text
