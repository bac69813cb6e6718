"""Why an attempt at a sequence ended, and what that means for the sequence.

Bad input is set aside at once and never tried again. What can pass is tried again, later each time
and a bounded number of times. A full disk, a bucket or a dispatcher that does not answer and an
interruption are nobody's fault and do not count; after a full disk it is later each time too.
"""

from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from datetime import UTC, datetime, timedelta
from typing import Any, Literal

from catalog.leases import Lease
from catalog.tables import Row

Cause = Literal[
    "done",
    "bad-input",
    "disk-full",
    "store-lost",
    "api-lost",
    "killed",
    "memory",
    "timeout",
    "system",
    "error",
    "interrupted",
    "cancelled",
    "superseded",
]
State = Literal["waiting", "running", "done", "set-aside", "failed"]

FINAL: Mapping[Cause, State] = {
    "done": "done",
    "bad-input": "set-aside",
    "error": "failed",
    "cancelled": "failed",
}
UNKNOWN = "unknown"
"""Cause of an attempt of whose end older code entered none."""
CAN_PASS: tuple[Cause, ...] = ("killed", "memory", "timeout", "system")
MAX_TRIES = 3
"""Attempts that may fail of what can pass, before the sequence counts as failed."""
FIRST_PAUSE_S = 20.0
LONGEST_PAUSE_S = 1800.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Ending:
    """How an attempt ended and what it took: columns of `attempts`."""

    cause: Cause
    reason: str | None = None
    run_id: str | None = None
    seconds: float = 0.0
    cpu_seconds: float | None = None
    compile_seconds: float | None = None
    peak_memory_bytes: int | None = None
    num_bytes: int | None = None
    effort: str | None = None
    software_version: str | None = None


def row_after(row: Row, ending: Ending, lease: Lease, *, first_pause_s: float) -> Row:
    """The row of a sequence as an attempt leaves it."""
    tries = row["tries"] + (ending.cause in CAN_PASS)
    state: State = FINAL.get(ending.cause, "waiting")
    reason, now = ending.reason, datetime.now(UTC)
    pause_s: float | None = None
    if ending.cause in CAN_PASS:
        if tries >= MAX_TRIES:
            state, reason = "failed", f"{reason} ({tries} attempts)"
        else:
            pause_s = min(LONGEST_PAUSE_S, first_pause_s * 2 ** (tries - 1))
    elif ending.cause == "disk-full":
        pause_s = min(LONGEST_PAUSE_S, max(first_pause_s, 2 * _pause_s(row)))
    return {
        **row,
        "state": state,
        "cause": ending.cause,
        "reason": reason,
        "run_id": ending.run_id or row["run_id"],
        "tries": tries,
        "attempts": row["attempts"] + 1,
        "seconds": (row["seconds"] or 0.0) + ending.seconds,
        "not_before": None if pause_s is None else now + timedelta(seconds=pause_s),
        "changed_at": now,
        "fence": lease.fence,
    }


def _pause_s(row: Row) -> float:
    """How long a sequence has paused after a full disk, if that is how its last attempt ended."""
    if row["cause"] != "disk-full" or row["not_before"] is None:
        return 0.0
    return (row["not_before"] - row["changed_at"]).total_seconds()


def attempt_id(lease: Lease) -> str:
    """The id of the attempt under a lease, in tables and flow runs."""
    return f"{lease.name}-{lease.fence}"


def split_attempt_id(name: str) -> tuple[str, int]:
    """The sequence and the number of its lease, of what `attempt_id` gives."""
    sequence_id, _, fence = name.rpartition("-")
    return sequence_id, int(fence)


def attempt_row(lease: Lease, ending: Ending) -> dict[str, Any]:
    """The row of an attempt; what it was and what was predicted stands in its lease."""
    started_at = datetime.fromtimestamp(lease.taken_at, UTC)
    predicted = ("seconds", "cpu_seconds", "memory_bytes", "num_bytes")
    facts = ("fleet", "scene_id", *(f"predicted_{name}" for name in predicted))
    return {
        "attempt_id": attempt_id(lease),
        "sequence_id": lease.name,
        **{name: lease.facts.get(name) for name in facts},
        "worker": lease.holder.name,
        "started_at": started_at,
        "ended_at": started_at + timedelta(seconds=ending.seconds),
        **asdict(ending),
    }


def by_cause(attempts: Iterable[Row]) -> dict[str, list[Row]]:
    """Attempts by how they ended, in the order of the words for it; `unknown` where none is."""
    found: dict[str, list[Row]] = {}
    for row in attempts:
        found.setdefault(row["cause"] or UNKNOWN, []).append(row)
    return dict(sorted(found.items()))
