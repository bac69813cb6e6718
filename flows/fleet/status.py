"""How a fleet stands, as its commands say it."""

from collections.abc import Mapping, Sequence
from typing import Any, get_args

from catalog.fleets import FleetLedger
from catalog.retries import State
from catalog.tables import Row
from flows.fleet.limits import lacks_disk, over_budget
from flows.fleet.manifest import Budget
from flows.fleet.resource_forecast import forecast_error

STATES: tuple[State, ...] = get_args(State)
SHOWN = (
    *("configuration", "fit_seed", "cameras"),
    *("state", "reason", "run_id", "seconds", "attempts"),
)
"""Columns of a sequence."""
ENDED: tuple[State, ...] = ("done", "set-aside")
"""Nothing more is to be done, and nothing is amiss with the fleet."""


def fleet_status(ledger: FleetLedger, fleet: str) -> dict[str, Any]:
    """What `fleet status --json` prints.

    Raises:
        UnknownRecordError: there is no such fleet.
    """
    rows = ledger.rows(fleet)
    counts = counts_of(rows)
    attempts = ledger.attempts(fleet)
    is_open = counts["waiting"] or counts["running"]
    budget = Budget.model_validate_json(rows[0]["budget"])
    return {
        "fleet": fleet,
        "store": ledger.store.name,
        "counts": counts,
        "held_back": (over_budget(rows) or lacks_disk(ledger, budget)) if is_open else None,
        "sequences": [
            {"scene": row["scene_id"], **{name: row[name] for name in SHOWN}} for row in rows
        ],
        "cost": {
            "seconds": sum(row["seconds"] or 0.0 for row in attempts),
            "cpu_seconds": sum(row["cpu_seconds"] or 0.0 for row in attempts),
            "attempts": len(attempts),
        },
        "forecast_error": forecast_error(attempts),
    }


def counts_of(rows: Sequence[Row]) -> dict[str, int]:
    """How many sequences are in each state, in the order in which they go through them."""
    return {state: sum(row["state"] == state for row in rows) for state in STATES}


def is_over(status: Mapping[str, Any]) -> bool:
    """Whether every sequence is done, or set aside with a reason."""
    return sum(status["counts"][state] for state in ENDED) == len(status["sequences"])
