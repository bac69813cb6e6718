"""`lidarpainter chart`, `size`, `stress`, `figures`: measured, drawn and put into pages."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from flows.cli.output import print_json, print_table, say_status, tell
from flows.cli.shared_options import AsJson, Settings, described, parse_names
from lidarpainter_models.errors import ConfigError

if TYPE_CHECKING:
    from catalog.points import Point
    from flows.fleet.manifest import Configuration, Manifest
    from flows.parameters import ReconstructParameters

NOT_OVER = 2
"""How the command ends where a table was left."""
COLUMNS = ("scene", "configuration", "seed", "cpu_seconds", "num_gaussians")
SHOWN = ("recorded_psnr", "aside_psnr", "aside_depth")
"""Qualities in the table."""

WORDS = """
scenes: Scene as dataset/sequence, such as pandaset/002.
out: Folder that the pictures are written to.
preset: Preset that is changed in one thing at a time: brief, preview, balanced or paper.
seeds: Number of seeds of the fit that each point is made with; bars show how far they differ.
only: Ways to compare, with commas between: preset, no-painter, overlay, warp, first-fit, one-round,
  steps-x0.25, steps-x0.5, steps-x2, painted-views-x0.5, gaussians-x0.5 or gaussians-x2; all if
  absent.
size.only: What is changed, with commas between: gaussians, harmonics, steps, rounds or
  painted-views; all if absent.
stress.only: Causes of faults, with commas between: beams, reach, dropout, clutter, clock,
  pose-noise, camera-yaw, focal-length, box-noise, missing-boxes, false-boxes, wrong-classes,
  exposure, white-balance, motion-blur, darkness, dirt, swapped, missing-cameras or frame-rate; all
  if absent.
figures.only: Names of the tables to write, as the manifest has them, with commas between; all if
  absent.
workers: Number of points made at once, each in a process of its own.
levels: Number of levels of each cause, from mild on.
manifest: TOML file with the tables and the fleets behind them, described in docs/measuring.md.
"""


@described(WORDS)
def chart(  # noqa: PLR0913 - the options of a command
    scenes: list[str],
    out: Annotated[Path, typer.Option()],
    preset: str = "preview",
    train_cameras: str | None = None,
    seeds: Annotated[int, typer.Option(min=1, max=100)] = 3,
    only: str | None = None,
    workers: Annotated[int, typer.Option(min=1)] = 1,
    accept_stale: bool = False,
    settings: Settings = None,
    as_json: AsJson = False,
) -> None:
    """Chart speed against accuracy: painters, rounds, steps and sizes, with bars over seeds.

    Whatever ends it, the same command goes on. Points that are done are only drawn.

    Example: lidarpainter chart synthetic/street-0001 --seeds 2 --out chart
    """
    from flows.measure.chart import chart_of
    from flows.measure.configurations import chart_ways

    ways = chart_ways(_given(preset, scenes, settings))
    names = _known(only, [way.name for way in ways])
    chosen = [way for way in ways if way.name in names]
    sweep = _sweep("chart", scenes, chosen, preset, train_cameras, seeds, settings)
    points = _made(sweep, workers=workers, accept_stale=accept_stale)
    _show(chart_of(points, out), as_json=as_json)


@described(WORDS)
def size(  # noqa: PLR0913 - the options of a command
    scenes: list[str],
    out: Annotated[Path, typer.Option()],
    preset: str = "preview",
    train_cameras: str | None = None,
    seeds: Annotated[int, typer.Option(min=1, max=100)] = 3,
    only: str | None = None,
    workers: Annotated[int, typer.Option(min=1)] = 1,
    accept_stale: bool = False,
    settings: Settings = None,
    as_json: AsJson = False,
) -> None:
    """Chart quality against size: Gaussians, harmonics, steps, rounds, painted views.

    Whatever ends it, the same command goes on. Points that are done are only drawn.

    Example: lidarpainter size synthetic/street-0001 --only gaussians --out size
    """
    from flows.measure.chart import sizes_of
    from flows.measure.configurations import size_factors

    compared = size_factors(_given(preset, scenes, settings))
    names = _known(only, [factor.name for factor in compared])
    factors = [factor for factor in compared if factor.name in names]
    levels = [level for factor in factors for level in factor.levels]
    sweep = _sweep("size", scenes, levels, preset, train_cameras, seeds, settings)
    points = _made(sweep, workers=workers, accept_stale=accept_stale)
    _show(sizes_of(points, factors, out), as_json=as_json)


@described(WORDS)
def stress(  # noqa: PLR0913 - the options of a command
    scenes: list[str],
    out: Annotated[Path, typer.Option()],
    preset: str = "preview",
    train_cameras: str | None = None,
    seeds: Annotated[int, typer.Option(min=1, max=100)] = 1,
    only: str | None = None,
    levels: Annotated[int, typer.Option(min=1)] = 4,
    workers: Annotated[int, typer.Option(min=1)] = 1,
    accept_stale: bool = False,
    settings: Settings = None,
    as_json: AsJson = False,
) -> None:
    """Spoil recordings by one cause at a time, and hold painted scenes against unpainted ones.

    Faults are in the frames that train; those that judge stay as recorded, but for what is said of
    cameras and actors. Whatever ends it, the same command goes on.

    Example: lidarpainter stress synthetic/street-0001 --only beams,clock --out stress
    """
    from catalog.store import existing_store
    from flows.measure.stress import (
        PUBLISHED,
        SEEDS_IN_DOUBT,
        WAYS,
        in_doubt,
        spoil_scenes,
        stress_of,
        trials_of,
    )
    from flows.measure.sweep import foretold, was_asked
    from lidarpainter_models.stress.causes import CAUSES

    def sweep(names: Sequence[str], **more: Any) -> "Manifest":  # noqa: ANN401 - fields of it
        asked = _sweep("stress", names, WAYS, preset, train_cameras, seeds, settings)
        return asked.model_copy(update={"publish": PUBLISHED, **more})

    store, causes = existing_store(), _known(only, list(CAUSES))
    trials = trials_of(store, scenes, causes, levels)
    if not was_asked("stress", store):  # they tell what all others will take
        _made(sweep(scenes), workers=workers, accept_stale=accept_stale)
    times = {scene: sum(trial.scene == scene for trial in trials) for scene in scenes}
    cost = foretold(sweep(scenes), store, times)
    tell(f"{len(trials)} recordings are spoilt and made with painting and without, {cost} in all")
    spoil_scenes(store, trials)
    everything = sweep([*scenes, *(trial.spoilt for trial in trials)])
    points = _made(everything, workers=workers, accept_stale=accept_stale)
    if doubted := in_doubt(points, trials):
        tell(f"painting seems to harm {len(doubted)} recordings: {SEEDS_IN_DOUBT} seeds of them")
        # a fleet of their own: one that is asked for less forgets the rest
        more = tuple(range(seeds, SEEDS_IN_DOUBT))
        again = sweep(doubted, name="stress-in-doubt", fit_seeds=more)
        points += _made(again, workers=workers, accept_stale=accept_stale)
    _show(stress_of(points, trials, out), as_json=as_json)


@described(WORDS)
def figures(
    manifest: Path,
    only: str | None = None,
    workers: Annotated[int, typer.Option(min=1)] = 1,
    feature_weights: Path | None = None,
    accept_stale: bool = False,
    as_json: AsJson = False,
) -> None:
    """Write the tables of pages: make the runs that they lack, enter their figures into a record.

    A table that lacks a run stays as it is and is named; the command then ends with 2. Whatever
    ends it, the same command goes on.

    Example: lidarpainter figures docs/figures.toml --only results
    """
    chosen = parse_names(only, "--only")
    say_status("reading the tables")
    from catalog.store import open_store
    from flows.cli.progress import shown_progress
    from flows.measure.publication import LEFT, Publisher

    store = open_store()
    store.make()
    weights = {} if feature_weights is None else {"feature_weights": feature_weights}
    publisher = Publisher(
        store=store, workers=workers, accept_stale=accept_stale, say=tell, weights=weights
    )
    with shown_progress():
        result = publisher.publish(manifest, chosen)
    if as_json:
        print_json(result)
    else:
        cells = [[name, one["state"], one["reason"]] for name, one in result["tables"].items()]
        written = "\n".join([result["record"], *result["pages"]])
        print_table("tables", ["table", "state", "reason"], cells, written, num_text_columns=3)
    if any(one["state"] == LEFT for one in result["tables"].values()):
        raise typer.Exit(NOT_OVER)


def _known(only: str | None, names: Sequence[str]) -> tuple[str, ...]:
    """The names that were chosen, or all."""
    chosen = parse_names(only, "--only") or tuple(names)
    if unknown := [name for name in chosen if name not in names]:
        raise ConfigError(f"--only {', '.join(unknown)!r}: expected some of {', '.join(names)}")
    return chosen


def _given(
    preset: str, scenes: Sequence[str], settings: Sequence[str] | None
) -> "ReconstructParameters":
    """What is asked for, of which one thing is changed at a time."""
    from flows.overrides import with_overrides
    from flows.presets import preset as preset_named

    return with_overrides(preset_named(preset, scenes[0]), settings or ())


def _sweep(
    name: str,
    scenes: Sequence[str],
    configurations: Sequence["Configuration"],
    preset: str,
    train_cameras: str | None,
    seeds: int,
    settings: Sequence[str] | None,
) -> "Manifest":
    from flows.fleet.manifest import STORED, Manifest, Source

    cameras = parse_names(train_cameras, "--train-cameras")
    return Manifest(
        name=name,
        preset=preset,
        set=tuple(settings or ()),
        source=(Source(dataset=STORED, scenes=tuple(scenes), cameras=cameras),),
        configuration=tuple(configurations),
        fit_seeds=tuple(range(seeds)),
        publish=("scores",),
    )


def _made(sweep: "Manifest", *, workers: int, accept_stale: bool) -> list["Point"]:
    from catalog.store import existing_store
    from flows.measure.sweep import run_sweep

    ways = len(sweep.configuration) * len(sweep.fit_seeds)
    number = len(sweep.source[0].scenes or ())
    tell(f"{number * ways} points: {number} scenes in {ways} ways")
    return run_sweep(sweep, existing_store(), workers=workers, accept_stale=accept_stale, say=tell)


def _show(result: dict[str, Any], *, as_json: bool) -> None:
    if as_json:
        print_json(result)
        return
    cells = [[point.get(name) for name in (*COLUMNS, *SHOWN)] for point in result["points"]]
    note = "\n".join([*result["says"], *result["pictures"]])
    print_table("points", [*COLUMNS, *SHOWN], cells, note, num_text_columns=2)
