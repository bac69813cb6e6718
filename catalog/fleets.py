"""The truth about fleets: which sequences were asked for, who works on them, how attempts ended.

`sequences` and `attempts` are tables of the catalog; who works on a sequence is a lease. That a
sequence is running is not stored: it waits, and a live lease bears its name. So nothing can be left
running. Every row of `sequences` has a number that only grows, and whoever writes a row needs a
higher one than it has: a worker that lost its lease to another is refused, two that ask at once
cannot undo each other. Where a manifest has moved a sequence, only that is written: whoever works
on it goes on.
"""

from collections.abc import Iterable, Mapping, Sequence, Set
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from typing import Any

from catalog.digests import canonical_json, digest_text
from catalog.errors import UnknownRecordError
from catalog.leases import Lease, Leases
from catalog.retries import FIRST_PAUSE_S, Ending, attempt_row, row_after, split_attempt_id
from catalog.store import Store
from catalog.tables import Row

TABLE, ATTEMPTS = "sequences", "attempts"
ID_LENGTH = 16
PLACE = ("position", "priority", "budget")
"""Columns that say when a sequence is made and what it may take, not what it is."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Wish:
    """A sequence that a manifest asks for; the columns of `sequences` say what each field means."""

    fleet: str
    scene_id: str
    cameras: tuple[str, ...] | None
    configuration: str | None = None
    fit_seed: int = 0
    position: int
    priority: int
    variants: tuple[str, ...]
    asked: str
    asked_digest: str
    code_digest: str
    budget: str

    @property
    def sequence_id(self) -> str:
        """One scene may be asked for with several choices of cameras, and in several ways."""
        cameras = self.cameras and sorted(self.cameras)
        way = [self.configuration, self.fit_seed]
        return digest_text(canonical_json([self.fleet, self.scene_id, cameras, *way]))[:ID_LENGTH]

    def row(self) -> dict[str, Any]:
        """The row before the first attempt."""
        cameras = None if self.cameras is None else list(self.cameras)
        stated = {**asdict(self), "cameras": cameras, "variants": list(self.variants)}
        return {"sequence_id": self.sequence_id, **stated, "attempts": 0, **_waiting(fence=0)}


class FleetLedger:
    """The fleets of one store."""

    def __init__(
        self, store: Store, *, leases: Leases | None = None, first_pause_s: float = FIRST_PAUSE_S
    ) -> None:
        self.store = store
        self.leases = leases or Leases(store.objects("leases"))
        self.flow_runs = Leases(
            store.objects("flow-runs"), time_to_live_s=self.leases.time_to_live_s
        )
        """Leases of flow runs that dispatch: who is alive, beside who works on what."""
        self._first_pause_s = first_pause_s

    def latest(self) -> str:
        """Name of the fleet that was asked for last.

        Raises:
            UnknownRecordError: there is none.
        """
        found = _latest_of(self.store.tables.rows(TABLE))
        if found is None:
            raise UnknownRecordError(f"no fleet in {self.store.name}: `fleet run` makes one")
        return found

    def rows(self, fleet: str) -> list[Row]:
        """The sequences of a fleet, in the order of its manifest, those in hand as running.

        Raises:
            UnknownRecordError: there is no such fleet.
        """
        rows = self.store.tables.rows(TABLE)
        found = [row for row in rows if row["fleet"] == fleet]
        if not found:
            known = ", ".join(sorted({row["fleet"] for row in rows})) or "none"
            raise UnknownRecordError(f"no fleet {fleet!r} in {self.store.name}, there is {known}")
        live = {lease.name for lease in self.leases.held() if not self.leases.has_expired(lease)}
        for row in found:
            if row["state"] == "waiting" and row["sequence_id"] in live:
                row["state"] = "running"
        return sorted(found, key=lambda row: row["position"])

    def attempts(self, fleet: str) -> list[Row]:
        """All attempts at sequences of a fleet, by the time of their end."""
        found = self.store.tables.rows(ATTEMPTS, where={"fleet": [fleet]})
        return sorted(found, key=lambda row: row["ended_at"])

    def ask(self, wishes: Sequence[Wish], *, accept_stale: bool = False) -> None:
        """Enter what a manifest asks for; what is done as asked stays done.

        What is no longer among the wishes is forgotten, but not its attempts: where it is asked for
        again, their numbers are not used again. `accept_stale` leaves what was done by other code
        as it is.
        """
        fleet = wishes[0].fleet
        rows = self.store.tables.rows(TABLE)
        known = {row["sequence_id"]: row for row in rows if row["fleet"] == fleet}
        wanted = {wish.sequence_id: wish.row() for wish in wishes}
        is_any_done = any(row["state"] == "done" for row in known.values())
        standing = _standing_runs(self.store) if is_any_done else set()
        changed, moved = [], []
        for sequence_id in wanted.keys() & known.keys():
            new, old = wanted[sequence_id], known[sequence_id]
            if _is_to_redo(new, old, standing, accept_stale=accept_stale):
                changed.append({**new, **_spent(old), "fence": old["fence"] + 1})
            elif any(new[name] != old[name] for name in PLACE):
                moved.append(new)
        dropped = sorted(known.keys() - wanted.keys())
        fences = self._last_fences(wanted.keys() - known.keys())
        added = [{**wanted[name], "fence": fence} for name, fence in fences.items()]
        tables = self.store.tables
        tables.add_absent(TABLE, added)
        tables.replace_older(TABLE, changed, "fence")
        tables.replace_columns(TABLE, moved, PLACE)
        if dropped:
            tables.delete(TABLE, "sequence_id", dropped)
        if not added and not changed and _latest_of(rows) != fleet:
            tables.replace_columns(TABLE, list(wanted.values()), ["asked_at"])

    def take(self, row: Row, facts: Mapping[str, Any]) -> Lease | None:
        """Begin to work on a sequence that waits, or None if somebody else does or has."""
        named = {"fleet": row["fleet"], "scene_id": row["scene_id"], **facts}
        lease = self.leases.take(row["sequence_id"], above=row["fence"], facts=named)
        if lease is None:
            return None
        today = self.store.tables.find(TABLE, row["sequence_id"])
        if today is not None and today["fence"] == row["fence"] and today["state"] == "waiting":
            return lease
        self.leases.give_back(lease)
        return None

    def end(self, lease: Lease, ending: Ending) -> bool:
        """Enter how an attempt ended, and give its lease back; whether the sequence follows it.

        An attempt under an old number is refused: then the sequence stays as it is.
        """
        row = self.store.tables.find(TABLE, lease.name)
        follows = row is not None and row["fence"] < lease.fence
        if row is not None and follows:
            after = row_after(row, ending, lease, first_pause_s=self._first_pause_s)
            follows = self.store.tables.replace_older(TABLE, [after], "fence") == 1
        self.store.tables.add_absent(ATTEMPTS, [attempt_row(lease, ending)])
        self.leases.give_back(lease)
        return follows

    def reconcile(self, why: Ending | None = None) -> list[str]:
        """Enter the end of every attempt whose worker is gone; returns a line for each.

        Where it is not known `why` it is gone, it counts as killed.
        """
        ended = []
        for lease in self.leases.held():
            if self.leases.has_expired(lease):
                ending = self._lost(lease, why)
                self.end(lease, ending)
                ended.append(f"{lease.facts.get('scene_id')}: {ending.reason or ending.cause}")
        return ended

    def retry(self, fleet: str, scenes: Iterable[str] = ()) -> list[str]:
        """Let what failed be tried again, or what is named though it was set aside.

        Returns:
            The scenes.

        Raises:
            UnknownRecordError: a scene is not of this fleet.
        """
        rows, named = self.rows(fleet), set(scenes)
        if unknown := named - {row["scene_id"] for row in rows}:
            raise UnknownRecordError(f"fleet {fleet} has no scene {', '.join(sorted(unknown))}")
        states = ("failed", "set-aside") if named else ("failed",)
        again = [
            {**row, **_waiting(fence=row["fence"] + 1), **_spent(row)}
            for row in rows
            if row["state"] in states and (not named or row["scene_id"] in named)
        ]
        self.store.tables.replace_older(TABLE, again, "fence")
        return [row["scene_id"] for row in again]

    def cancel(self, fleet: str) -> list[str]:
        """Let nothing of a fleet begin, and end what is running; returns the scenes.

        Workers find at their next heartbeat that their lease is gone.
        """
        left = [row for row in self.rows(fleet) if row["state"] in ("waiting", "running")]
        stopped = {
            "state": "failed",
            "cause": "cancelled",
            "reason": "cancelled; `fleet run` or `fleet retry` goes on",
        }
        rows = [{**row, **stopped, "fence": row["fence"] + 1} for row in left]
        self.store.tables.replace_older(TABLE, rows, "fence")
        names = {row["sequence_id"] for row in left}
        for lease in self.leases.held():
            if lease.name in names:
                self.leases.give_back(lease)
                ending = Ending(cause="cancelled", seconds=lease.beat_at - lease.taken_at)
                self.store.tables.add_absent(ATTEMPTS, [attempt_row(lease, ending)])
        return [row["scene_id"] for row in left]

    def _last_fences(self, sequence_ids: Set[str]) -> dict[str, int]:
        """The highest number under which each of some sequences was ever worked on, or 0."""
        found = dict.fromkeys(sequence_ids, 0)
        where = {"sequence_id": sequence_ids}
        ended = self.store.tables.arrow(ATTEMPTS, columns=["attempt_id"], where=where)
        used = [split_attempt_id(one) for one in ended["attempt_id"].to_pylist()]
        used += [(lease.name, lease.fence) for lease in self.leases.held() if sequence_ids]
        for name, fence in used:
            if name in found:
                found[name] = max(found[name], fence)
        return found

    def _lost(self, lease: Lease, why: Ending | None) -> Ending:
        """How an attempt ended whose worker cannot tell."""
        took = replace(
            why or Ending(cause="killed"),
            seconds=lease.beat_at - lease.taken_at,
            cpu_seconds=lease.facts.get("cpu_seconds"),
            peak_memory_bytes=lease.facts.get("memory_bytes"),
        )
        row = self.store.tables.find(TABLE, lease.name)
        if row is not None and row["cause"] is not None and row["fence"] == lease.fence:
            # it died right after it had told
            told = {name: row[name] for name in ("cause", "reason", "run_id")}
            return replace(took, **told)
        if why is not None:
            return took
        silence = f"gave no sign of life for {self.leases.time_to_live_s:.0f} s"
        what = "was ended from outside" if lease.holder.is_gone else silence
        return replace(took, reason=f"the worker {lease.holder.name} {what}")


def _standing_runs(store: Store) -> set[str]:
    """Complete runs, all there, of scenes as the store has them now."""
    there, tables = store.artefacts.ids(), store.tables
    now = {row["scene_id"]: row["content_digest"] for row in tables.rows("scenes")}
    return {
        row["run_id"]
        for row in tables.rows("runs")
        if row["status"] == "complete"
        and there.issuperset(row["artefacts"])
        and now.get(row["scene_id"], row["scene_digest"]) == row["scene_digest"]
    }


def _latest_of(rows: Sequence[Row]) -> str | None:
    """The fleet that was asked for last; None where there is none."""
    return max(rows, key=lambda row: row["asked_at"])["fleet"] if rows else None


def _is_to_redo(new: Row, old: Row, standing: Set[str], *, accept_stale: bool) -> bool:
    if new["asked_digest"] != old["asked_digest"] or old["cause"] == "cancelled":
        return True
    if new["code_digest"] != old["code_digest"] and not accept_stale:
        return True
    return old["state"] == "done" and old["run_id"] not in standing


def _spent(row: Row) -> dict[str, Any]:
    """The columns about all attempts, whatever became of them."""
    return {name: row[name] for name in ("attempts", "seconds")}


def _waiting(*, fence: int) -> dict[str, Any]:
    """The columns of a sequence that waits for its first attempt, or for its first one again."""
    now = datetime.now(UTC)
    return {
        "state": "waiting",
        "cause": None,
        "reason": None,
        "run_id": None,
        "tries": 0,
        "seconds": None,
        "not_before": None,
        "asked_at": now,
        "changed_at": now,
        "fence": fence,
    }
