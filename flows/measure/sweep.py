"""A sweep: configurations on scenes with seeds, each point a sequence of a fleet.

So it has what a fleet has: what two points share is computed once, workers may die, the same
command goes on, and further points join those that are done. Figures come from the catalog alone.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from catalog.errors import CatalogError
from catalog.fleets import FleetLedger
from catalog.points import Point, points_of
from catalog.store import Store
from flows.fleet.asked import wishes
from flows.fleet.local_workers import run_workers, starter
from flows.fleet.manifest import STORED, Configuration, Manifest, Source
from flows.fleet.status import counts_of


@dataclass(frozen=True, kw_only=True)
class Sweep:
    """What is to be compared, on what."""

    name: str
    """Of the fleet."""
    scenes: tuple[str, ...]
    cameras: tuple[str, ...] | None
    preset: str
    settings: tuple[str, ...]
    """Of all configurations."""
    configurations: tuple[Configuration, ...]
    seeds: tuple[int, ...]

    @property
    def manifest(self) -> Manifest:
        """As a fleet is asked for."""
        return Manifest(
            name=self.name,
            preset=self.preset,
            set=self.settings,
            source=(Source(dataset=STORED, scenes=self.scenes, cameras=self.cameras),),
            configuration=self.configurations,
            fit_seeds=self.seeds,
            publish=("scores",),
        )


def run_sweep(
    sweep: Sweep, store: Store, *, workers: int, accept_stale: bool, say: Callable[[str], None]
) -> list[Point]:
    """Make the points that are not there yet; returns all.

    `accept_stale` leaves what older code has done as it is; `say` takes a line of progress.

    Raises:
        CatalogError: a point could not be made; the others are done.
    """
    ledger = FleetLedger(store)
    for line in ledger.reconcile():
        say(line)
    ledger.ask(wishes(sweep.manifest, Path()), accept_stale=accept_stale)
    counts = counts_of(ledger.rows(sweep.name))
    if still := counts["waiting"] + counts["running"]:
        start = starter(store.address, sweep.name, threads=1)
        run_workers(ledger, sweep.name, start, min(workers, still), say)
    points, missing = points_of(store, sweep.name)
    if missing:
        first = missing[0]
        raise CatalogError(
            f"{len(missing)} of {len(points) + len(missing)} points are not done, such as "
            f"{first['configuration']} on {first['scene_id']}: {first['reason'] or first['state']}"
        )
    return points
