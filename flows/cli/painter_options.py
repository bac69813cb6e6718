"""Options that the commands of `lidarpainter painter` share, and what their texts mean."""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from lidarpainter_models.errors import ConfigError

_SIZE = re.compile(r"([1-9]\d{0,4})x([1-9]\d{0,4})")
_SEEDS = re.compile(r"(\d+)(?::(\d+))?")
MOST_STREETS = 10_000

Settings = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        help="Changes one setting, such as training.steps=500; `lidarpainter settings --of "
        "train` lists them all. May be repeated.",
    ),
]
Seeds = Annotated[
    str | None,
    typer.Option(
        help="Synthetic streets by their seeds: a range 1000:1004, the last excluded, or a list "
        "1000,1007."
    ),
]
Scenes = Annotated[
    list[str] | None,
    typer.Option("--scene", help="A stored scene as dataset/sequence. May be repeated."),
]
Split = Annotated[
    str,
    typer.Option(
        help="Which frames of recorded scenes are fitted, the others giving true images: "
        "alternate (every second one), forward:17:8 (every second of the first 17, and the "
        "last 8 are not), or all."
    ),
]
Cameras = Annotated[
    str | None,
    typer.Option(
        help="Names of the cameras of recorded scenes, with commas between; all if absent."
    ),
]
Pairs = Annotated[
    list[str] | None,
    typer.Option(help="A folder of pairs that were harvested before. May be repeated."),
]
Features = Annotated[
    Path | None,
    typer.Option(
        help="File with weights of SqueezeNet 1.1, for the feature distance; it is left out if "
        "absent."
    ),
]
Budget = Annotated[
    float | None,
    typer.Option(help="The maximum CPU seconds of training; the default of the painter if absent."),
]
Steps = Annotated[
    int | None,
    typer.Option(
        help="Number of optimiser steps of training; the default of the painter if absent."
    ),
]
Base = Annotated[
    str | None,
    typer.Option(
        help="Train the one-step painter on this model: a folder in diffusers' layout or an id, "
        "with a preset after a colon. Without it, the small painter."
    ),
]
Start = Annotated[
    Path | None,
    typer.Option(
        help="Weights that the training goes on from: nano, or a .safetensors file; it starts "
        "anew if absent."
    ),
]
Inputs = Annotated[
    str | None,
    typer.Option(
        help="Inputs that the small painter sees, of `lidarpainter painter info`, with commas "
        "between; all if absent."
    ),
]
Prompts = Annotated[
    str | None,
    typer.Option(
        help="Styles to learn, with commas between: clear, which must be among them, foggy, "
        "night and rain; clear alone if absent."
    ),
]
HeldBack = Annotated[
    float,
    typer.Option(
        help="Share from 0 to 1 of the true images that is kept from training, to score by."
    ),
]
LpipsBackbone = Annotated[
    Path | None,
    typer.Option(
        help="File with torchvision's weights of VGG-16, AlexNet or SqueezeNet 1.1, for the loss"
        " with --base."
    ),
]
LpipsHeads = Annotated[
    Path | None,
    typer.Option(
        help="File with the LPIPS heads (version 0.1) of the same network, for the loss with "
        "--base."
    ),
]
Processes = Annotated[
    int,
    typer.Option(
        min=1, help="Number of processes that train with --base, each on a GPU of its own."
    ),
]
Out = Annotated[
    Path | None,
    typer.Option(
        help="Folder, or .safetensors file, that the weights and their record are written to."
    ),
]
Device = Annotated[
    str,
    typer.Option(
        help="Where painters run: auto (a GPU if there is one), cpu, cuda, or cuda:N for the "
        "N-th GPU."
    ),
]


def parse_seeds(text: str | None) -> tuple[int, ...]:
    """`1000:1004` (the last excluded), `1000,1007`, or both mixed.

    Raises:
        ConfigError: the text says something else, names a seed twice, or too many.
    """
    if text is None:
        return ()
    seeds: list[int] = []
    for part in text.split(","):
        match = _SEEDS.fullmatch(part.strip())
        chosen = range(0)
        if match:
            first = int(match[1])
            chosen = range(first, int(match[2]) if match[2] else first + 1)
        if not chosen:
            raise ConfigError(f"seeds {text!r}: expected such as 1000:1004 or 1000,1007")
        if len(seeds) + chosen.stop - chosen.start > MOST_STREETS:
            raise ConfigError(f"seeds {text!r}: expected at most {MOST_STREETS} streets")
        seeds += chosen
    if len(set(seeds)) != len(seeds):
        raise ConfigError(f"seeds {text!r}: a seed is named twice")
    return tuple(seeds)


def parse_size(text: str) -> tuple[int, int]:
    """Width and height of an image: `1024x576`.

    Raises:
        ConfigError: the text says something else.
    """
    match = _SIZE.fullmatch(text)
    if match is None:
        raise ConfigError(f"size {text!r}: expected such as 1024x576")
    return int(match[1]), int(match[2])


def parse_inputs(text: str | None) -> frozenset[str] | None:
    """Names of the small painter's inputs with commas between.

    Raises:
        ConfigError: the network cannot be built from them.
    """
    from lidarpainter_models.painter.nano.candidates import check_inputs

    if text is None:
        return None
    return check_inputs(part.strip() for part in text.split(","))


def parse_paths(texts: Sequence[str] | None, option: str) -> tuple[Path, ...]:
    """Paths or names, given by repeating an option or with commas between.

    Raises:
        ConfigError: one is empty or given twice.
    """
    paths = tuple(part.strip() for text in texts or () for part in text.split(","))
    if not all(paths) or len(set(paths)) != len(paths):
        raise ConfigError(f"{option} {','.join(texts or ())!r}: expected each once, none empty")
    return tuple(Path(path) for path in paths)
