"""What holds a fleet back: the room on the disk, the memory of the machine, its budget of hours."""

from collections.abc import Sequence

from catalog.fleets import FleetLedger
from catalog.leases import Lease, Leases
from catalog.tables import Row
from flows.fleet.manifest import Budget
from tasks.job_limits import usable_memory_bytes

GIGABYTE = 1e9
MEMORY_SHARE = 0.9
"""Part of the machine's memory that sequences may be planned into."""


def lacks_disk(ledger: FleetLedger, budget: Budget, num_bytes: float = 0.0) -> str | None:
    """Why a sequence that makes so much may not begin; None if there is room."""
    free = ledger.store.free_bytes
    needed = budget.free_disk_gb * GIGABYTE + num_bytes
    if free >= needed:
        return None
    return (
        f"{free / GIGABYTE:.2f} GB are free in {ledger.store.root}, "
        f"expected {needed / GIGABYTE:.2f} GB before a sequence begins"
    )


def over_budget(rows: Sequence[Row]) -> str | None:
    """Why nothing more may begin: the hours of the fleet are used up; None if it may."""
    hours = Budget.model_validate_json(rows[0]["budget"]).hours
    spent = sum(row["seconds"] or 0.0 for row in rows) / 3600
    if hours is None or spent < hours:
        return None
    return f"the budget of {hours} h is used up: {spent:.2f} h"


def admits(leases: Leases, lease: Lease, budget: Budget) -> bool:
    """Whether a sequence in hand may begin beside what this machine already works on.

    The one that was taken first always may: it would never begin otherwise.
    """
    others = [one for one in work_here(leases) if one.name != lease.name]
    if all((lease.taken_at, lease.name) < (one.taken_at, one.name) for one in others):
        return True
    return fits_beside(others, _planned_bytes(lease), budget)


def work_here(leases: Leases) -> list[Lease]:
    """What this machine works on."""
    return [one for one in leases.held() if leases.is_near(one) and not leases.has_expired(one)]


def fits_beside(others: Sequence[Lease], num_bytes: float, budget: Budget) -> bool:
    """Whether there is memory for a sequence beside others; alone it always fits."""
    limit = budget.memory_gb * 1e9 if budget.memory_gb else MEMORY_SHARE * usable_memory_bytes()
    return not others or num_bytes + sum(map(_planned_bytes, others)) <= limit


def _planned_bytes(lease: Lease) -> float:
    """What a sequence in hand is thought to take, or takes already."""
    known = (lease.facts.get("predicted_memory_bytes"), lease.facts.get("memory_bytes"))
    return max(float(one or 0.0) for one in known)
