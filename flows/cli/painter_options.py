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
    typer.Option("--set", help="Any of `lidarpainter settings --of train`. May be repeated."),
]
Seeds = Annotated[
    str | None, typer.Option(help="Synthetic streets by seed: 1000:1004 or 1000,1007.")
]
Scenes = Annotated[
    list[str] | None, typer.Option("--scene", help="A stored scene. May be repeated.")
]
Split = Annotated[
    str, typer.Option(help="Split of recorded scenes: alternate, forward:17:8 or all.")
]
Cameras = Annotated[
    str | None, typer.Option(help="Cameras of recorded scenes, with commas between.")
]
Pairs = Annotated[
    list[str] | None,
    typer.Option(help="A folder of pairs harvested before. May be repeated."),
]
Features = Annotated[
    Path | None, typer.Option(help="SqueezeNet 1.1 weights for the feature distance.")
]
Budget = Annotated[float | None, typer.Option(help="CPU seconds of training.")]
Steps = Annotated[int | None, typer.Option(help="Optimiser steps of training.")]
Base = Annotated[
    str | None,
    typer.Option(
        help="Train the one-step painter on this model: a folder in diffusers' layout or an id, "
        "with a preset after a colon. Without it, the small painter."
    ),
]
Start = Annotated[
    Path | None, typer.Option(help="Go on from these weights: nano, or a .safetensors file.")
]
Inputs = Annotated[
    str | None,
    typer.Option(help="What the small painter may see, with commas between; by default all."),
]
Prompts = Annotated[
    str | None,
    typer.Option(help="clear, and styles to learn beside it: clear,foggy,night,rain."),
]
HeldBack = Annotated[
    float, typer.Option(help="Share of the true images kept from training, to judge by.")
]
LpipsBackbone = Annotated[
    Path | None,
    typer.Option(help="torchvision's VGG-16, AlexNet or SqueezeNet 1.1, for the loss with --base."),
]
LpipsHeads = Annotated[
    Path | None, typer.Option(help="LPIPS 0.1 heads of the same network, for the loss.")
]
Processes = Annotated[
    int, typer.Option(min=1, help="Train with --base in so many processes, a GPU for each.")
]
Out = Annotated[
    Path | None,
    typer.Option(help="Folder, or .safetensors file, for the weights and their record."),
]
Device = Annotated[str, typer.Option(help="Where painters run: auto, cpu, cuda or cuda:N.")]


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
