"""A sweep: configurations on scenes with seeds, each point a sequence of a fleet.

It has what a fleet has: what two points share is computed once, workers may die, the same command
goes on, and further points join those that are done. Figures come from the catalog alone.
"""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from catalog.errors import CatalogError, ConflictError
from catalog.fleets import TABLE as SEQUENCES
from catalog.fleets import FleetLedger, Wish
from catalog.points import Point, points_of
from catalog.store import Store
from catalog.tables import Row
from flows.fleet.asked_sequences import Asked, wishes
from flows.fleet.local_workers import run_workers, starter
from flows.fleet.manifest import Manifest
from flows.fleet.resource_forecast import ResourceForecast
from flows.fleet.status import counts_of
from tasks.opened import open_scene

THREADS = 1
"""Threads of a worker that makes points."""


def run_sweep(
    sweep: Manifest, store: Store, *, workers: int, accept_stale: bool, say: Callable[[str], None]
) -> list[Point]:
    """Make the points that are not there yet; returns all.

    `accept_stale` leaves what older code has done as it is; `say` takes a line of progress.

    Raises:
        CatalogError: a point could not be made; the others are done.
    """
    points, missing = make_points(sweep, store, workers=workers, accept_stale=accept_stale, say=say)
    if missing:
        raise CatalogError(undone(points, missing))
    return points


def make_points(
    manifest: Manifest,
    store: Store,
    *,
    workers: int,
    accept_stale: bool,
    say: Callable[[str], None],
) -> tuple[list[Point], list[Row]]:
    """Make the points of a fleet that are not there yet, one thread each, and say what is to come.

    Its sources name no folder. Returns the points that are done, and the sequences that are not.

    Raises:
        SceneError: a stored scene is not there.
        ConflictError: meanwhile another command has asked for other points under this name.
    """
    for scene_id in (one for source in manifest.source for one in source.scenes or ()):
        open_scene(store, scene_id)
    ledger = FleetLedger(store)
    for line in ledger.reconcile():
        say(line)
    wanted = wishes(manifest, Path())
    ledger.ask(wanted, accept_stale=accept_stale)
    rows = ledger.rows(manifest.name)
    counts = counts_of(rows)
    if still := counts["waiting"] + counts["running"]:
        say(f"{manifest.name}: {_cost(store, rows)}")
        start = starter(store.address, manifest.name, threads=THREADS)
        run_workers(ledger, manifest.name, start, min(workers, still), say)
    made = points_of(store, manifest.name)
    _require_asked(wanted, ledger)
    return made


def _require_asked(wanted: Sequence[Wish], ledger: FleetLedger) -> None:
    """See that a fleet is still asked for as it was."""
    fleet, store = wanted[0].fleet, ledger.store
    asked = {(wish.sequence_id, wish.asked_digest) for wish in wanted}
    found = {(row["sequence_id"], row["asked_digest"]) for row in ledger.rows(fleet)}
    if asked != found:
        raise ConflictError(
            f"{fleet} in {store.name}: another command has asked for other points under this name "
            f"meanwhile, {len(asked & found)} of {len(asked)} are left, expected one command at a "
            "time; the same one again makes what is missing"
        )


def undone(points: Sequence[Point], missing: Sequence[Row]) -> str:
    """In one line, which points of a fleet are not done, and why."""
    first = missing[0]
    made = first["configuration"] or first["fleet"]
    return (
        f"{len(missing)} of {len(points) + len(missing)} points are not done, such as "
        f"{made} on {first['scene_id']}: {first['reason'] or first['state']} (`fleet retry "
        f"{first['fleet']}` makes what failed wait again)"
    )


def was_asked(name: str, store: Store) -> bool:
    """Whether a store knows a sweep of that name."""
    return any(row["fleet"] == name for row in store.tables.rows(SEQUENCES))


def foretold(sweep: Manifest, store: Store, times: Mapping[str, int]) -> str:
    """What the points of each scene take so many times over, in words."""
    wanted = wishes(sweep, Path())
    return _took(store, [(wish.asked, times[wish.scene_id]) for wish in wanted])


def _cost(store: Store, rows: Sequence[Row]) -> str:
    """What is to be made, and what that will take."""
    waiting = [(row["asked"], 1) for row in rows if row["state"] == "waiting"]
    return f"{len(waiting)} of {len(rows)} points are to be made, {_took(store, waiting)}"


def _took(store: Store, asked: Sequence[tuple[str, int]]) -> str:
    """What sequences will take, each so many times, by what those of the store have taken."""
    forecast = ResourceForecast.of(store)
    costs = [
        (forecast.predict(Asked.model_validate_json(one)).cpu_seconds, times)
        for one, times in asked
    ]
    known = [(cost, times) for cost, times in costs if cost is not None]
    if not known:
        return "at a cost that nothing tells yet"
    minutes = sum(cost * times for cost, times in known) / 60
    some = "" if len(known) == len(costs) else f" for {sum(times for _, times in known)} of them"
    return f"about {minutes:.0f} CPU minutes{some}"
