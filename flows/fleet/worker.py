"""A worker: takes one sequence after the other until a fleet has none left.

It asks the catalog what waits, takes a lease, makes the sequence, and enters how that ended. Any
number of workers may run, on any number of machines that share the store, and each may die at any
moment: whoever looks next enters that and goes on.
"""

import json
import os
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from functools import partial
from typing import Literal, NoReturn

import lidarpainter_models
from catalog.errors import StorageError
from catalog.fleets import FleetLedger
from catalog.leases import Holder, Lease
from catalog.retries import Ending, attempt_id
from catalog.tables import Row
from flows.fleet.asked_sequences import Asked
from flows.fleet.error_causes import cause_of, is_storage_away
from flows.fleet.flow_runs import api_lost
from flows.fleet.heartbeat import Heartbeat
from flows.fleet.limits import admits, fits_beside, lacks_disk, over_budget, work_here
from flows.fleet.manifest import Budget
from flows.fleet.resource_forecast import ResourceForecast
from flows.fleet.work import Work
from flows.interruption import at_interruption
from tasks.progress import ProgressListener, subject, working_on

Event = Literal["said", "stage-began", "stage-waits", "stage-ended"]
POLL_S = 2.0
FORECAST_EVERY_S = 30.0
"""How long the forecast goes by what it read last."""
MOST_HELD_BACK = 8
"""Sequences for which there is no memory now, before no further ones are looked at."""
ENDED_ITSELF = 3
"""Exit code of a worker that had to leave its work; another one takes its place."""


@dataclass(kw_only=True)
class Worker:
    """Works on one fleet."""

    ledger: FleetLedger
    fleet: str
    work: Work
    say: Callable[[str], None]
    poll_s: float = POLL_S
    _told: str = ""
    _known_forecast: tuple[float, ResourceForecast] | None = None
    _entering: threading.Lock = field(default_factory=threading.Lock)

    def run(self) -> None:
        """Work until nothing waits and nobody else works, or the budget is used up."""
        self.ledger.store.tables.keep_open()
        while True:
            try:
                if self._step():
                    return
            except StorageError as error:
                if not is_storage_away(error):
                    raise
                self._pause(str(error))

    def _step(self) -> bool:
        """Make one sequence, or wait a little; whether there is nothing left to do."""
        for line in self.ledger.reconcile():
            self.say(line)
        rows = self.ledger.rows(self.fleet)
        if not any(row["state"] in ("waiting", "running") for row in rows):
            return True
        if spent := over_budget(rows):
            self.say(spent)
            return True
        if lost := api_lost():
            self._pause(lost)
            return False
        taken = self._take(rows)
        if taken is None:
            time.sleep(self.poll_s)
        else:
            with working_on(scene=taken[0]["scene_id"]):
                self._attempt(*taken)
            self.ledger.store.release()
        return False

    def _take(self, rows: Sequence[Row]) -> tuple[Row, Lease] | None:
        """The next sequence that may begin, in hand; None if there is none now."""
        now = datetime.now(UTC)
        due = [r for r in rows if r["state"] == "waiting" and (r["not_before"] or now) <= now]
        forecast, others, held_back = self._forecast(), work_here(self.ledger.leases), 0
        for row in sorted(due, key=lambda row: (-row["priority"], row["position"])):
            if held_back == MOST_HELD_BACK:
                return None
            prediction = forecast.predict(Asked.model_validate_json(row["asked"]))
            budget = Budget.model_validate_json(row["budget"])
            if lacking := lacks_disk(self.ledger, budget, prediction.num_bytes or 0.0):
                self._pause(lacking, sleeps=False)
                return None
            if not fits_beside(others, prediction.memory_bytes or 0.0, budget):
                held_back += 1
                continue
            lease = self.ledger.take(row, prediction.facts())
            if lease is None:
                continue
            if admits(self.ledger.leases, lease, budget):  # others may have begun meanwhile
                self._told = ""
                return row, lease
            self.ledger.leases.give_back(lease)
            held_back += 1
        return None

    def _attempt(self, row: Row, lease: Lease) -> None:
        asked = Asked.model_validate_json(row["asked"])
        hours = Budget.model_validate_json(row["budget"]).hours_per_sequence
        beat = Heartbeat(
            self.ledger.leases,
            lease,
            limit_s=hours and hours * 3600,
            on_lost=lambda: self._leave(beat, Ending(cause="superseded", reason="lease lost")),
            on_late=lambda: self._leave(
                beat, Ending(cause="timeout", reason=f"took longer than {hours} h")
            ),
        )
        self.say(f"{asked.scene_id}: begins, attempt {row['attempts'] + 1}")
        version = lidarpainter_models.__version__
        effort = self._forecast().effort(asked)
        is_first = row["cause"] is None  # else it may go on where another has stopped
        with beat, at_interruption(partial(self._end, beat, Ending(cause="interrupted"))):
            try:
                made = self.work(asked, self.ledger.store.address, attempt_id(lease))
                ending = Ending(
                    cause="done",
                    run_id=made.run_id,
                    num_bytes=made.num_bytes,
                    peak_memory_bytes=made.peak_memory_bytes,
                    effort=effort.to_json() if effort and is_first and made.is_whole else None,
                    software_version=version,
                )
            except Exception as error:  # noqa: BLE001 - whatever it is, it is entered
                cause, reason = cause_of(error)
                ending = Ending(cause=cause, reason=reason, software_version=version)
        self._end(beat, ending)

    def _end(self, beat: Heartbeat, ending: Ending) -> None:
        """Enter how an attempt ended; where the store is away, as soon as it is back.

        Raises:
            StorageError: it is away, and the attempt was interrupted: that cannot wait.
        """
        with self._entering:
            took = replace(ending, **beat.took())
            peak = max(took.peak_memory_bytes or 0, ending.peak_memory_bytes or 0)
            took = replace(took, peak_memory_bytes=peak)
            while True:
                try:
                    follows = self.ledger.end(beat.lease, took)
                    break
                except StorageError as error:
                    if not is_storage_away(error) or ending.cause == "interrupted":
                        raise
                    self._pause(str(error))
        scene = beat.lease.facts["scene_id"]
        what = ending.cause if follows else "refused, it is in other hands"
        self.say(f"{scene}: {what} after {took.seconds:.1f} s {ending.reason or ''}".rstrip())

    def _leave(self, beat: Heartbeat, ending: Ending) -> NoReturn:
        """End this process from the thread of the heartbeat, unless the end is being entered."""
        if self._entering.acquire(blocking=False):
            self._entering.release()
            self._end(beat, ending)
            os._exit(ENDED_ITSELF)
        raise SystemExit

    def _forecast(self) -> ResourceForecast:
        """The forecast that goes by what is known now, or was a short while ago."""
        now = time.monotonic()
        if self._known_forecast is None or now - self._known_forecast[0] > FORECAST_EVERY_S:
            self._known_forecast = (now, ResourceForecast.of(self.ledger.store))
        return self._known_forecast[1]

    def _pause(self, why: str, *, sleeps: bool = True) -> None:
        if why != self._told:
            self.say(f"paused: {why}")
            self._told = why
        if sleeps:
            time.sleep(self.poll_s)


class EventLog(ProgressListener):
    """Writes what a worker says, and when stages begin and end, as JSON lines.

    {"time": "...", "fleet": "...", "worker": "...", "event": "stage-ended",
     "scene": "pandaset/002", "run": "...", "stage": "fit", "seconds": 61.2, "is_new": true}
    """

    def __init__(self, fleet: str, write: Callable[[str], object]) -> None:
        self._write = write
        self._always = {"fleet": fleet, "worker": Holder.current().name}

    def __call__(self, text: str) -> None:
        """Enter what the worker says, in words."""
        self._enter("said", text=" ".join(text.split()))

    def started(self, stage: str) -> None:
        """Enter that a stage begins."""
        self._enter("stage-began", stage=stage)

    def waiting(self, stage: str, process_id: str) -> None:
        """Enter that another process makes the same."""
        self._enter("stage-waits", stage=stage, process=process_id)

    def finished(self, stage: str, seconds: float, *, is_new: bool) -> None:
        """Enter that a stage is over, and what it took when it was computed."""
        self._enter("stage-ended", stage=stage, seconds=round(seconds, 3), is_new=is_new)

    def _enter(self, event: Event, **facts: str | float | bool) -> None:
        now = datetime.now(UTC).isoformat(timespec="milliseconds")
        line = {"time": now, **self._always, "event": event, **subject(), **facts}
        self._write(json.dumps(line, ensure_ascii=False) + "\n")
