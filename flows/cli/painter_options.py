"""What the options of `lidarpainter painter` mean, and where trained painters are written."""

import json
import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lidarpainter_models.errors import ConfigError

if TYPE_CHECKING:
    from lidarpainter_models.painter.nano.training import NanoTrainingConfig

WEIGHTS_SUFFIX = ".safetensors"
_SIZE = re.compile(r"([1-9]\d{0,4})x([1-9]\d{0,4})")
_SEEDS = re.compile(r"(\d+)(?::(\d+))?")


def parse_seeds(text: str | None) -> tuple[int, ...]:
    """`1000:1004` (the last excluded), `1000,1007`, or both mixed.

    Raises:
        ConfigError: the text says something else, or names a seed twice.
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
        seeds += chosen
    if len(set(seeds)) != len(seeds):
        raise ConfigError(f"seeds {text!r}: a seed is named twice")
    return tuple(seeds)


def parse_size(text: str) -> tuple[int, int]:
    """Width and height of a picture: `1024x576`.

    Raises:
        ConfigError: the text says something else.
    """
    match = _SIZE.fullmatch(text)
    if match is None:
        raise ConfigError(f"size {text!r}: expected such as 1024x576")
    return int(match[1]), int(match[2])


def parse_inputs(text: str) -> frozenset[str]:
    """Names of inputs with commas between.

    Raises:
        ConfigError: the network cannot be built from them.
    """
    from lidarpainter_models.painter.nano.candidates import check_inputs

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


def with_length(
    training: "NanoTrainingConfig",
    inputs: frozenset[str],
    budget_s: float | None,
    steps: int | None,
    prompts: tuple[str, ...] | None = None,
) -> "NanoTrainingConfig":
    """The settings with other inputs and prompts, and as long as asked for.

    Raises:
        ConfigError: both lengths are given, one is not positive, or a prompt is no style.
    """
    if budget_s is not None and steps is not None:
        raise ConfigError("give --budget or --steps, not both")
    network = replace(training.network, inputs=inputs, prompts=prompts or training.network.prompts)
    if steps is None:
        steps = training.steps
    return replace(training, network=network, max_cpu_s=budget_s, steps=steps)


def write_painter(weights: Path, record: dict[str, Any], out: Path) -> dict[str, str]:
    """Copy a painter out of the store; returns where its two files are.

    Args:
        weights: the file in the store.
        record: how it was trained.
        out: a folder, or a `.safetensors` file beside which the record goes.

    Raises:
        StorageError: the disk refuses.
    """
    from lidarpainter_models.painter.whole_files import write_whole

    path = out if out.suffix == WEIGHTS_SUFFIX else out / weights.name
    record_path = path.with_suffix(".json")
    write_whole(path, weights.read_bytes())
    write_whole(record_path, (json.dumps(record, indent=1, sort_keys=True) + "\n").encode())
    return {"weights": str(path), "record_path": str(record_path)}
