"""Help stands alone: an example of known words, and a sentence with the values of each option."""

import re
import shlex
from typing import Literal, get_args, get_origin

import pytest
import typer
from commands import succeed

from catalog.asset_queries import SIDES
from catalog.schemas import TABLES
from flows.cli.evaluate import PROTOCOLS
from flows.cli.main import app
from flows.measure.configurations import chart_ways, size_factors
from flows.presets import PRESETS, preset
from lidarpainter_models.conditioning.settings import PreviousUse
from lidarpainter_models.export.formats import FORMAT_NAMES, FORMATS
from lidarpainter_models.geometry.trajectory_words import TRAJECTORY_WORDS
from lidarpainter_models.painter.styles import STYLE_PROMPTS
from lidarpainter_models.stress.causes import CAUSES


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
GIVEN = preset("preview", "dataset/sequence")
SENTENCE = re.compile(r"[A-Z][^\n]*[.]")
TYPERS_OWN = ("install_completion", "show_completion")
VALUES = {
    "--preset": PRESETS,
    "--format": FORMAT_NAMES,
    "--split": ("alternate", "forward:17:8", "all"),
    "--previous": get_args(PreviousUse)[1:],
    "--device": ("auto", "cpu", "cuda", "cuda:N"),
    "--trajectory": tuple(TRAJECTORY_WORDS),
    "--beside": ("recorded", "unpainted"),
    "--prompt": STYLE_PROMPTS,
    "--protocol": PROTOCOLS,
    "table": TABLES,
    ("assets", "export", "--format"): [row.name for row in FORMATS if row.takes_assets],
    ("assets", "list", "--sides"): SIDES,
    ("chart", "--only"): [way.name for way in chart_ways(GIVEN)],
    ("size", "--only"): [factor.name for factor in size_factors(GIVEN)],
    ("stress", "--only"): CAUSES,
}
"""What options take that is a list somewhere; an argument is called by its name."""


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
def test_every_option_says_in_a_sentence_what_it_is(path):
    for one in COMMANDS[path].params:
        text = one.help or ""
        assert SENTENCE.fullmatch(text), (one.name, text)
        assert len(text.split()) > 2, (one.name, text)
        assert [name for name in values_of(path, one) if not names(text, name)] == [], one.name
    assert "Example" in succeed(*path, "--help").out


def test_global_options_say_in_a_sentence_what_they_are():
    for one in typer.main.get_command(app).params:
        assert one.name in TYPERS_OWN or SENTENCE.fullmatch(one.help), one.name


def values_of(path, option):
    """The values that an option takes, where they are a list."""
    annotation, name = option.type_descriptor.annotation, max(option.opts, key=len)
    if get_origin(annotation) is Literal:
        return get_args(annotation)
    return VALUES.get((*path, name), VALUES.get(name, ()))


def names(text, value):
    """Whether a text names a value as a word of its own."""
    return re.search(rf"(?<![\w-]){re.escape(value)}(?![\w-])", text)


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
