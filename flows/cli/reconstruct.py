"""`lidarpainter reconstruct`: fit, paint, judge and report one scene."""

from dataclasses import replace
from typing import Annotated, Any

import typer

from flows.cli.output import Cell, format_bytes, print_json, print_pairs, print_table, say_status
from flows.cli.shared_options import (
    AsJson,
    DeviceName,
    Painter,
    Settings,
    parse_bytes,
    parse_names,
    parse_seconds,
)
from lidarpainter_models.errors import ConfigError

FITS = ("fit", "refine")
FIRST_FIT_SHARE = 0.6
"""Of a time limit; the rounds after it share the rest, as they do the steps of a preset."""
Sideways = Annotated[
    str | None, typer.Option(help="Metres to both sides to paint at, such as 2,3; at most 8.")
]
Upwards = Annotated[str | None, typer.Option(help="Metres up to paint at, such as 1.5; at most 8.")]
Rounds = Annotated[
    int | None,
    typer.Option(help="How often to paint and go on, 0 or more; the preset's if absent."),
]
Memory = Annotated[
    str | None,
    typer.Option(help="Most of a fit's process on a CPU, such as 6GB: fewer Gaussians if need be."),
]
TimeLimit = Annotated[
    str | None, typer.Option(help="Of all fits together, such as 10min: fewer steps if need be.")
]
Split = Annotated[
    str | None,
    typer.Option(
        help="alternate (every second frame judges), forward:17:8 (so many fit: judge), all."
    ),
]


def reconstruct(  # noqa: PLR0913 - the options of a command
    scene: Annotated[str, typer.Argument(help="dataset/sequence, as ingested.")],
    preset: Annotated[str, typer.Option(help="brief, preview, balanced or paper.")] = "preview",
    painter: Painter = None,
    device: DeviceName = "auto",
    shift: Sideways = None,
    up: Upwards = None,
    rounds: Rounds = None,
    split: Split = None,
    train_cameras: Annotated[
        str | None, typer.Option(help="Cameras to train on, with commas between; all if absent.")
    ] = None,
    seed: Annotated[
        int | None, typer.Option(min=0, help="Decides in which order the fit sees its views.")
    ] = None,
    memory: Memory = None,
    time_limit: TimeLimit = None,
    evaluate: Annotated[
        bool, typer.Option("--evaluate/--no-evaluate", help="Judge the scene, or later.")
    ] = True,
    report: Annotated[
        bool, typer.Option("--report/--no-report", help="Write the page about the run.")
    ] = True,
    settings: Settings = None,
    as_json: AsJson = False,
) -> None:
    """Turn a stored scene into a fitted, painted, judged and reported one.

    Example: lidarpainter reconstruct pandaset/002 --train-cameras front_camera

    Unpainted, for comparison: lidarpainter reconstruct pandaset/002 --painter none
    """
    from catalog.store import existing_store
    from flows.cli.running import run_reconstruction
    from flows.overrides import with_changes, with_overrides
    from flows.presets import preset as preset_named

    parameters = preset_named(preset, scene)
    changes: dict[str, Any] = {
        "painter": painter,
        "device": device,
        "rounds": rounds,
        "split": split,
        "train_cameras": parse_names(train_cameras),
        "judge": evaluate,
        "report": report,
    }
    changes = {name: value for name, value in changes.items() if value is not None}
    if shift is not None or up is not None:
        changes["novel"] = shifted(parameters.novel, shift, up)
    parameters = with_overrides(with_changes(parameters, changes), settings or [])
    parameters = with_changes(parameters, of_fits(parameters, seed, memory, time_limit))
    say_status(f"opening {scene}")
    result = run_reconstruction(parameters, existing_store())
    if as_json:
        print_json(result)
    else:
        show(result)


def shifted(novel: Any, shift: str | None, up: str | None) -> Any:  # noqa: ANN401 - imported late
    """Guidance settings that paint at the given distances instead.

    Raises:
        ConfigError: a distance is no positive number.
    """
    from lidarpainter_models.geometry.shifts import Shift

    sideways = [Shift(lateral_m=side * metres) for metres in _distances(shift) for side in (1, -1)]
    return replace(novel, shifts=(*sideways, *(Shift(up_m=metres) for metres in _distances(up))))


def of_fits(
    parameters: Any,  # noqa: ANN401 - imported late
    seed: int | None,
    memory: str | None,
    time_limit: str | None,
) -> dict[str, Any]:
    """The fits with what was asked of all of them.

    Raises:
        ConfigError: memory or time limit cannot be read.
    """
    asked = {"seed": seed, "memory_bytes": None if memory is None else parse_bytes(memory)}
    common = {name: value for name, value in asked.items() if value is not None}
    fits = {name: replace(getattr(parameters, name), **common) for name in FITS}
    if time_limit is not None:
        limit_s, rounds = parse_seconds(time_limit), parameters.rounds
        first_s = limit_s * FIRST_FIT_SHARE if rounds else limit_s
        fits["fit"] = replace(fits["fit"], time_limit_s=first_s)
        if rounds:
            fits["refine"] = replace(fits["refine"], time_limit_s=(limit_s - first_s) / rounds)
    return fits


def show(result: dict[str, Any]) -> None:
    """The result as tables."""
    from lidarpainter_models.evaluation.score_tables import SCORE_NOTE, score_columns, score_rows

    title = f"{result['scene']}, painter {result['painter']}"
    columns = score_columns(result["painter"])
    if rows := score_rows(result):
        print_table(title, columns, rows, SCORE_NOTE)
    pairs: dict[str, Cell] = {
        "run": result["run_id"],
        "Gaussians": result["num_gaussians"],
        **({"stopped early": "at its time limit"} if result.get("stopped_early") else {}),
        **{
            name: "taken back: worse beside the path than before it, made again without paintings"
            for name, gain in (result.get("gains") or {}).items()
            if gain["is_taken_back"]
        },
        "peak memory": format_bytes(result["peak_memory_bytes"]),
        **{f"{name}, s": seconds for name, seconds in result["seconds"].items()},
        "report": result["report"],
    }
    print_pairs("run", pairs)


def _distances(text: str | None) -> list[float]:
    try:
        values = [float(part) for part in text.split(",")] if text else []
    except ValueError:
        values = [0.0]
    if not all(0 < value < float("inf") for value in values):
        raise ConfigError(f"{text!r}: expected positive metres with commas between, such as 2,3")
    return values
