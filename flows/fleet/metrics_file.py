"""How a fleet stands in the text format of Prometheus, for the collector that reads files.

`node_exporter --collector.textfile.directory` takes `*.prom` files. Counters go on over all `fleet
run` of a name, since attempts are never forgotten.
"""

from pathlib import Path

from prometheus_client import CollectorRegistry, Gauge, write_to_textfile
from prometheus_client.core import CounterMetricFamily
from prometheus_client.registry import Collector

from catalog.errors import storage_errors
from catalog.fleets import FleetLedger
from catalog.retries import by_cause
from catalog.tables import Row
from flows.fleet.status import counts_of, forecast_error

PREFIX = "lidarpainter_fleet"
SPENT = {
    "seconds": ("wall", "Wall time of attempts in seconds."),
    "cpu_seconds": ("cpu", "CPU time of attempts in seconds."),
    "num_bytes": ("stored", "Size of what attempts made in bytes."),
}
"""Columns of attempts."""


def write_metrics(ledger: FleetLedger, fleet: str, path: Path) -> None:
    """Write the file whole.

    Raises:
        UnknownRecordError: there is no such fleet.
        StorageError: the file cannot be written.
    """
    rows = ledger.rows(fleet)
    attempts = ledger.attempts(fleet)
    registry = CollectorRegistry()
    registry.register(_Counted(fleet, attempts))
    states = Gauge(f"{PREFIX}_sequences", "By state.", ["fleet", "state"], registry=registry)
    for state, count in counts_of(rows).items():
        states.labels(fleet, state).set(count)
    free = Gauge("lidarpainter_store_free_bytes", "Room on its disk.", registry=registry)
    free.set(ledger.store.free_bytes)
    if attempts:
        last = Gauge(f"{PREFIX}_last_end_seconds", "Since 1970.", ["fleet"], registry=registry)
        last.labels(fleet).set(max(row["ended_at"] for row in attempts).timestamp())
    error = forecast_error(attempts)
    if error is not None:
        off = Gauge(f"{PREFIX}_forecast_error", "Median share.", ["fleet"], registry=registry)
        off.labels(fleet).set(error)
    with storage_errors(f"cannot write {path}"):
        path.parent.mkdir(parents=True, exist_ok=True)
        write_to_textfile(str(path), registry)


class _Counted(Collector):
    """Counters whose values are known: a client's own ones begin at zero."""

    def __init__(self, fleet: str, attempts: list[Row]) -> None:
        self._fleet = fleet
        self._attempts = attempts

    def collect(self) -> list[CounterMetricFamily]:
        """All of them."""
        ended = CounterMetricFamily(
            f"{PREFIX}_attempts", "By how they ended.", labels=["fleet", "cause"]
        )
        for cause, rows in by_cause(self._attempts).items():
            ended.add_metric([self._fleet, cause], len(rows))
        found = [ended]
        for column, (name, meaning) in SPENT.items():
            unit = "bytes" if column == "num_bytes" else "seconds"
            spent = CounterMetricFamily(f"{PREFIX}_{name}_{unit}", meaning, labels=["fleet"])
            spent.add_metric([self._fleet], sum(row[column] or 0 for row in self._attempts))
            found.append(spent)
        return found
