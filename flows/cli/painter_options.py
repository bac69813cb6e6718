"""What the options of `lidarpainter painter` mean, and where trained painters are written."""

import json
import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lidarpainter_models.errors import ConfigError

if TYPE_CHECKING:
    from tasks.painter.students import PainterTraining

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


def with_length(
    training: "PainterTraining",
    inputs: frozenset[str] | None,
    budget_s: float | None,
    steps: int | None,
    prompts: tuple[str, ...] | None = None,
) -> "PainterTraining":
    """The settings with other inputs and prompts where given, and as long as asked for.

    Raises:
        ConfigError: both lengths are given, one is not positive, a prompt is no style, or inputs
            are given for the one-step painter.
    """
    from lidarpainter_models.painter.nano.training import NanoTrainingConfig

    if budget_s is not None and steps is not None:
        raise ConfigError("give --budget or --steps, not both")
    steps = training.steps if steps is None else steps
    changes: dict[str, Any] = {"max_cpu_s": budget_s, "steps": steps}
    if isinstance(training, NanoTrainingConfig):
        old = training.network
        network = replace(old, inputs=inputs or old.inputs, prompts=prompts or old.prompts)
        return replace(training, network=network, **changes)
    if inputs is not None:
        raise ConfigError(
            "--inputs is for the small painter: the preset after --base wires the other, or "
            "--set training.network.inputs=render,lidar"
        )
    return replace(training, prompts=prompts or training.prompts, **changes)


def write_painter(weights: Path, record: dict[str, Any], out: Path) -> dict[str, str]:
    """Copy a painter out of the store; returns where its two files are.

    Args:
        weights: the file in the store.
        record: how it was trained.
        out: a folder, or a `.safetensors` file beside which the record goes.

    Raises:
        StorageError: the disk refuses.
    """
    from lidarpainter_models.storage.whole_files import write_whole

    path = out if out.suffix == WEIGHTS_SUFFIX else out / weights.name
    record_path = path.with_suffix(".json")
    write_whole(path, weights.read_bytes())
    write_whole(record_path, (json.dumps(record, indent=1, sort_keys=True) + "\n").encode())
    return {"weights": str(path), "record_path": str(record_path)}
