"""`lidarpainter painter info --preset` and `benchmark`: what the one-step painter costs."""

from pathlib import Path
from typing import Annotated, Any

import typer

from flows.cli.output import Cell, format_bytes, print_json, print_pairs, print_table
from flows.cli.painter_options import parse_size
from flows.cli.shared_options import AsJson
from lidarpainter_models.errors import ConfigError

Size = Annotated[str, typer.Option(help="Size of an image, WIDTHxHEIGHT.")]


def benchmark(
    size: Size = "512x288",
    rounds: Annotated[int, typer.Option(min=1, help="Processes per wiring, in turn.")] = 2,
    training: Annotated[
        bool, typer.Option("--training", help="Time one training step instead; some minutes.")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Time the one-step painter wired plainly, wired well, and with the tiny autoencoder.

    Random weights of the true size in bfloat16 on the CPU: half a minute of CPU time a round.
    """
    from tasks.painter.benchmark import compare_wirings

    width_px, height_px = parse_size(size)
    if training:
        _time_training(height_px, width_px, as_json=as_json)
        return
    found = compare_wirings(height_px, width_px, rounds)
    if as_json:
        print_json({"size_px": [width_px, height_px], "rounds": rounds, "wirings": found})
        return
    rows = [
        [
            wiring,
            one["cpu_seconds"],
            one["seconds"],
            format_bytes(one["peak_bytes"]),
            one["times_faster"],
            one["difference_to_plain"],
        ]
        for wiring, one in found.items()
    ]
    columns = ["wiring", "CPU s", "wall s", "peak memory", "times faster", "rgb difference"]
    note = "medians of a view; peak of the whole process; difference to plain over 16x16 pixels"
    print_table(f"one-step painter, {size}, bfloat16, random weights", columns, rows, note)


def _time_training(height_px: int, width_px: int, *, as_json: bool) -> None:
    from tasks.painter.benchmark import compare_training

    found = compare_training(height_px, width_px)
    if as_json:
        print_json({"size_px": [width_px, height_px], "training_step": found})
        return
    rows = [
        [preset, one["cpu_seconds"], one["seconds"], format_bytes(one["peak_bytes"])]
        for preset, one in found.items()
    ]
    print_table(
        f"a training step of the one-step painter, one view of {width_px}x{height_px}",
        ["preset", "CPU s", "wall s", "peak memory"],
        rows,
        "random weights in bfloat16, activations computed anew, no LPIPS; peak of the process",
    )


def show_preset(painter: str | None, preset: str, size: str, *, as_json: bool) -> None:
    """Print what a wiring costs, and whose weights it would stand on.

    Args:
        painter: a model in diffusers' layout whose licence is told; by default SD-Turbo as known.
        preset: name of the wiring.
        size: of an image, as text.
        as_json: print one JSON object.

    Raises:
        ConfigError: no such preset, or a size that is none.
        WeightsError: the model is not there.
    """
    from lidarpainter_models.painter.one_step.base_models import (
        KNOWN_LICENCES,
        SD_TURBO_HUB,
        TAESD_HUB,
        open_base,
    )
    from lidarpainter_models.painter.one_step.cost import describe_preset
    from lidarpainter_models.painter.one_step.presets import preset_named

    config = preset_named(preset)
    width_px, height_px = parse_size(size)
    if painter is not None and Path(painter).suffix == ".safetensors":
        raise ConfigError("--preset wires a model; a weights file has its own wiring")
    licence = KNOWN_LICENCES[SD_TURBO_HUB] if painter is None else open_base(painter).licence
    result: dict[str, Any] = {"preset": preset}
    result |= describe_preset(config, height_px=height_px, width_px=width_px)
    result |= {
        "licence": licence,
        "provenance": {
            "base": painter or SD_TURBO_HUB,
            "autoencoder": TAESD_HUB if config.autoencoder == "taesd" else "of the base",
            "weights": "brought by the user; none come with the package",
        },
    }
    if as_json:
        print_json(result)
        return
    pairs: dict[str, Cell] = {"architecture": result["architecture"].pop("summary")}
    pairs |= {f"parameters, {name}": count for name, count in result["parameters"].items()}
    pairs |= {f"TFLOP at {size}, {name}": count for name, count in result["tflop"].items()}
    pairs |= {f"bytes, {name}": format_bytes(count) for name, count in result["bytes"].items()}
    pairs |= {name: str(value) for name, value in result["architecture"].items()}
    pairs |= {"licence": licence, **result["provenance"]}
    print_pairs(f"one-step painter, {preset}", pairs)
