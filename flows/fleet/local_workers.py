"""Workers of a fleet as processes of this machine, for as long as the command runs.

Each has one thread unless the user has said otherwise: two that share two cores with threads of
their own take two and a half times the CPU time. One that dies is replaced; what it had in its
hands is entered as killed at once, and goes on with whoever is free. Where the store is away, they
wait for it, and so does the command.
"""

import os
import subprocess
import time
from collections.abc import Callable, Collection, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

from catalog.errors import CatalogError, StorageError
from catalog.fleets import FleetLedger
from catalog.retries import Ending
from catalog.store import open_store
from flows.fleet.error_causes import is_storage_away
from flows.fleet.status import counts_of
from flows.server import start_child

WATCH_S = 0.5
TELL_S = 5.0
STOP_S = 0.3
"""How long workers may take to end, of what an interrupted command has in all."""
MAX_EARLY_DEATHS = 3
"""Workers that may end one after the other before any of them has entered an attempt."""
THREAD_COUNTS = ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")

Start = Callable[[int], subprocess.Popen[bytes]]
"""Starts the worker of a number."""


def starter(store: Path, fleet: str, threads: int) -> Start:
    """Workers as the command starts them: `lidarpainter fleet work NAME`."""
    counts = dict.fromkeys(THREAD_COUNTS, str(threads))
    environment: Mapping[str, str] = {**os.environ, **counts}
    words = ["-m", "flows.cli", "--store", str(store), "--quiet", "fleet", "work", fleet]

    def start(number: int) -> subprocess.Popen[bytes]:
        path = log_path(store, fleet, number)
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("ab") as log:
            return start_child(words, log=log.fileno(), environment=environment)

    return start


def log_path(store: Path, fleet: str, number: int) -> Path:
    """Where a worker of this machine writes what it does."""
    return open_store(store).root / "logs" / f"fleet-{fleet}-{number}.log"


def run_workers(
    ledger: FleetLedger, fleet: str, start: Start, count: int, say: Callable[[str], None]
) -> None:
    """Keep so many workers at work until nothing is left for them.

    Raises:
        CatalogError: workers die before they do anything.
    """
    crew = _Crew(ledger=ledger, fleet=fleet, start=start, say=say)
    crew.workers = {number: start(number) for number in range(count)}
    try:
        while crew.workers:
            time.sleep(WATCH_S)
            crew.look()
    finally:
        if crew.workers:
            _stop(crew.workers.values())
            with suppress(CatalogError):  # whoever comes next enters it then
                ledger.reconcile(Ending(cause="interrupted", reason="the fleet was interrupted"))


@dataclass(kw_only=True)
class _Crew:
    """The workers of one command."""

    ledger: FleetLedger
    fleet: str
    start: Start
    say: Callable[[str], None]
    workers: dict[int, subprocess.Popen[bytes]] = field(default_factory=dict)
    _entered: int = -1
    """Attempts when a worker died last."""
    _early_deaths: int = 0
    _told_at: float = 0.0
    _told: str = ""

    def look(self) -> None:
        """See to the workers, and say how the fleet stands, or that the store is away."""
        try:
            self._replace_dead()
            self._tell()
        except StorageError as error:
            if not is_storage_away(error):
                raise
            self._say_once(f"paused: {error}")

    def _replace_dead(self) -> None:
        """Let workers go that are through, and put others in place of those that died."""
        for number, process in list(self.workers.items()):
            if process.poll() is None:
                continue
            if process.returncode != 0:
                self._count_death(number)
                self.workers[number] = self.start(number)
            else:
                del self.workers[number]

    def _tell(self) -> None:
        if time.monotonic() - self._told_at < TELL_S:
            return
        self._told_at = time.monotonic()
        counts = counts_of(self.ledger.rows(self.fleet))
        self._say_once(", ".join(f"{number} {state}" for state, number in counts.items() if number))

    def _say_once(self, line: str) -> None:
        if line != self._told:
            self.say(line)
        self._told = line

    def _count_death(self, number: int) -> None:
        """Enter what a dead worker had in its hands; give up where workers do nothing but die."""
        for line in self.ledger.reconcile():
            self.say(line)
        entered = sum(row["attempts"] for row in self.ledger.rows(self.fleet))
        self._early_deaths = self._early_deaths + 1 if entered == self._entered else 0
        self._entered = entered
        if self._early_deaths >= MAX_EARLY_DEATHS:
            path = log_path(self.ledger.store.address, self.fleet, number)
            raise CatalogError(f"workers of fleet {self.fleet} end at once; see {path}")


def _stop(processes: Collection[subprocess.Popen[bytes]]) -> None:
    """End workers: they enter that they were interrupted, as far as they get in the time."""
    for process in processes:
        process.terminate()
    deadline = time.monotonic() + STOP_S
    for process in processes:
        with suppress(subprocess.TimeoutExpired):
            process.wait(max(0.0, deadline - time.monotonic()))
    for process in processes:
        process.kill()
        process.wait()
