"""`lidarpainter reconstruct`: fit, paint, judge and report one scene."""

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from flows.cli.output import Cell, format_bytes, print_json, print_pairs, print_table, say_status
from flows.cli.shared_options import (
    AsJson,
    Painter,
    Settings,
    check_painter,
    described,
    parse_bytes,
    parse_names,
    parse_seconds,
)
from lidarpainter_models.errors import ConfigError

if TYPE_CHECKING:
    from catalog.store import Store

FITS = ("fit", "refine")
FILE_KEYS = {"preset": str, "painter": str, "set": list}
"""Keys of a file for --config, as in the manifest of a fleet, and what each holds."""
FIRST_FIT_SHARE = 0.6
"""Part of a time limit for the first fit; its rounds share the rest, as the steps of a preset."""

WORDS = """
preset: How much effort is made: brief (a minute or two), preview (minutes on a CPU), balanced (the
  best trade), or paper (the effort of the paper); preview if absent.
shift: Metres to both sides of the path at which views are painted, such as 2,3; at most 8. The
  preset's if absent. Views that are turned on the path are painted as well, as the preset has it.
up: Metres above the path at which views are painted, such as 1.5; at most 8. The preset's if
  absent.
rounds: Number of rounds, each one painting and the continued fit after it; 0 paints nothing. The
  preset's if absent.
split: Which frames are fitted and which are held out for scoring: alternate (every second one is
  held out), linspace (half of them at even steps are fitted, the last one too: the protocol of
  neurad-studio), forward:17:8 (every second of the first 17 is fitted, the last 8 are held out), or
  all (none is held out). The preset's if absent.
seed: Number that decides in which order the fit sees its views.
memory: The maximum memory of the process that fits on a CPU, such as 6GB or 800MB; the scene gets
  fewer Gaussians where it would take more. No limit if absent.
time_limit: The maximum time of all fits together, such as 90s, 10min or 2h; fits make fewer steps
  where they would take longer. No limit if absent.
evaluate: Score the scene on held-out views, or leave that to `lidarpainter evaluate`.
report: Write the page about the run, or leave it out.
config: TOML file with preset, painter and set, as a fleet's manifest has them; options given here
  count more.
view: Show the scene in a browser while it is fitted; only this machine can reach it.
tensorboard: Folder for TensorBoard event files with the losses of all fits; each fit's artefact has
  them as history.csv anyway.
"""


@described(WORDS)
def reconstruct(  # noqa: PLR0913 - the options of a command
    scene: str,
    preset: str | None = None,
    painter: Painter = None,
    device: str = "auto",
    shift: str | None = None,
    up: str | None = None,
    rounds: int | None = None,
    split: str | None = None,
    train_cameras: str | None = None,
    seed: Annotated[int | None, typer.Option(min=0)] = None,
    memory: str | None = None,
    time_limit: str | None = None,
    evaluate: Annotated[bool, typer.Option("--evaluate/--no-evaluate")] = True,
    report: Annotated[bool, typer.Option("--report/--no-report")] = True,
    settings: Settings = None,
    config: Path | None = None,
    view: bool = False,
    tensorboard: Path | None = None,
    as_json: AsJson = False,
) -> None:
    """Turn a stored scene into a fitted, painted, evaluated and reported one.

    Example: lidarpainter reconstruct pandaset/002 --train-cameras front_camera

    Unpainted, for comparison: lidarpainter reconstruct pandaset/002 --painter none

    A run that was stopped continues with the same command. Finished stages lie in
    STORE/artefacts, checkpoints of a running fit in STORE/work, until it is done.
    """
    from catalog.store import existing_store
    from flows.cli.running import run_reconstruction
    from flows.overrides import with_changes, with_overrides
    from flows.presets import preset as preset_named

    check_tensorboard(tensorboard)
    asked = read_config(config)
    parameters = preset_named(preset or asked.get("preset", "preview"), scene)
    given: dict[str, Any] = {
        "painter": painter or asked.get("painter"),
        "device": device,
        "rounds": rounds,
        "split": split,
        "train_cameras": parse_names(train_cameras, "--train-cameras"),
        "judge": evaluate,
        "report": report,
    }
    changes = {name: value for name, value in given.items() if value is not None}
    parameters = with_changes(parameters, changes | shifted(parameters.novel, shift, up))
    parameters = with_overrides(parameters, [*asked.get("set", []), *(settings or [])])
    parameters = with_changes(parameters, of_fits(parameters, seed, memory, time_limit))
    check_painter(parameters.painter)
    say_status(f"opening {scene}")
    store = existing_store()
    result = run_reconstruction(parameters, store, is_watched=view)
    write_events(store, result, tensorboard)
    (print_json if as_json else show)(result)


def read_config(path: Path | None) -> dict[str, Any]:
    """Read what a file for `--config` asks for, by its keys; nothing where there is no file.

    Raises:
        ConfigError: it cannot be read, is no TOML, or holds what such a file does not.
    """
    if path is None:
        return {}
    from flows.fleet.manifest import read_toml

    values = read_toml(path)
    for name, value in values.items():
        if name not in FILE_KEYS:
            known = ", ".join(FILE_KEYS)
            raise ConfigError(f"{path}: unknown key {name!r}, expected one of {known}")
        is_known = isinstance(value, FILE_KEYS[name])
        if not is_known or (name == "set" and not all(isinstance(one, str) for one in value)):
            what = "an array of 'key=value'" if name == "set" else "a string"
            raise ConfigError(f"{path}: {name}: expected {what}, got {value!r}")
    return values


def check_tensorboard(folder: Path | None) -> None:
    """Find out whether event files can be written, if a folder is given for them.

    Raises:
        ConfigError: the package that writes them is not installed.
    """
    if folder is None:
        return
    try:
        import tensorboard  # noqa: F401
    except ImportError:
        raise ConfigError(
            "--tensorboard needs the package tensorboard, which is not installed: "
            "pip install tensorboard"
        ) from None


def write_events(store: "Store", result: dict[str, Any], folder: Path | None) -> None:
    """Write the losses of every fit of a run as event files, in a folder for each fit.

    Nothing is written where there is no folder.
    """
    if folder is None:
        return
    from torch.utils.tensorboard import SummaryWriter

    from catalog.artefacts import ArtefactRef
    from tasks.stored import load_history

    for stage, place in result["artefacts"].items():
        ref = ArtefactRef(Path(place).parent.name, Path(place).name)
        if ref.kind != "gaussians":
            continue
        with SummaryWriter(str(folder / result["run_id"] / stage)) as writer:
            for entry in load_history(store, ref):
                for name in entry.keys() - {"step"}:
                    writer.add_scalar(name, entry[name], int(entry["step"]))


def shifted(
    novel: Any,  # noqa: ANN401 - imported late
    shift: str | None,
    up: str | None,
) -> dict[str, Any]:
    """Guidance settings that paint at the given distances, by their name; none without a distance.

    Raises:
        ConfigError: a distance is no positive number.
    """
    if shift is None and up is None:
        return {}
    from lidarpainter_models.geometry.shifts import Shift

    sideways = [Shift(lateral_m=side * metres) for metres in _distances(shift) for side in (1, -1)]
    upwards = [Shift(up_m=metres) for metres in _distances(up)]
    turned = [one for one in novel.shifts if not (one.lateral_m or one.up_m)]
    return {"novel": replace(novel, shifts=(*sideways, *upwards, *turned))}


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
