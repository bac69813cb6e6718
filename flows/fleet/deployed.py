"""What a Prefect work pool runs of a fleet: firings that look at the manifest, and workers.

A firing is short. It enters what is new, closes what nobody works on any more, and sees to it that
there are as many workers as are wanted, so whatever was killed since the last one is replaced. A
worker is one flow run that makes one sequence after the other: a process for each sequence would
pay eight seconds of imports, and a queue of thousands starves (see `flow_runs`).
"""

from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING

from prefect import flow, get_run_logger
from prefect.runtime import flow_run as this_run

from catalog.fleets import FleetLedger
from catalog.store import open_store
from flows.environment import prepare_environment
from flows.fleet.asked import wishes
from flows.fleet.flow_runs import FIRING, WORK, alive, close_lost_runs, open_runs
from flows.fleet.limits import lacks_disk, over_budget
from flows.fleet.manifest import Budget, read_manifest
from flows.fleet.status import counts_of
from flows.fleet.work import make_sequence
from flows.fleet.worker import Worker

if TYPE_CHECKING:
    from prefect.client.schemas.objects import FlowRun

OPEN = ("SCHEDULED", "PENDING", "RUNNING")


@flow(name=FIRING, persist_result=False)
def fleet(manifest: str, store: str, workers: int, accept_stale: bool = False) -> dict[str, int]:
    """Look at a manifest once: enter what is new, and start the workers that are missing.

    Args:
        manifest: path of the file, as this machine sees it.
        store: of the fleet.
        workers: that are wanted.
        accept_stale: leave what was done by other code as it is.

    Returns:
        How many sequences are in each state.
    """
    say, path = get_run_logger().info, Path(manifest)
    asked = read_manifest(path)
    wanted = wishes(asked, path.parent)
    found = open_store(store)
    found.make()
    ledger = FleetLedger(found)
    with alive(ledger, this_run.id):
        for line in [*ledger.reconcile(), *close_lost_runs(ledger)]:
            say(line)
        _drop_late_firings(ledger, asked.name)
        ledger.ask(wanted, accept_stale=accept_stale)
        rows = ledger.rows(asked.name)
        counts = counts_of(rows)
        budget = Budget.model_validate_json(rows[0]["budget"])
        if why := over_budget(rows) or lacks_disk(ledger, budget):
            say(f"nothing begins: {why}")
        else:
            _start_workers(ledger, asked.name, min(workers, counts["waiting"] + counts["running"]))
    say(", ".join(f"{number} {state}" for state, number in counts.items()))
    return counts


@flow(name=WORK, persist_result=False)
def fleet_work(fleet: str, store: str) -> None:
    """Work on a fleet until nothing is left to do.

    Args:
        fleet: name of the manifest.
        store: of the fleet.
    """
    prepare_environment(log_level=None)
    ledger = FleetLedger(open_store(store))
    with alive(ledger, this_run.id):
        Worker(ledger=ledger, fleet=fleet, work=make_sequence, say=get_run_logger().info).run()


def fleet_tag(name: str) -> str:
    """Of every firing and worker of a fleet."""
    return f"fleet:{name}"


def _start_workers(ledger: FleetLedger, name: str, wanted: int) -> None:
    """Ask for the workers that are neither at work nor on their way."""
    from prefect.client.orchestration import get_client

    there = [run for run in _runs(ledger, name, OPEN) if "fleet" in run.parameters]
    with get_client(sync_client=True) as client:
        deployment = client.read_deployment_by_name(f"{WORK}/{name}")
        for _ in range(wanted - len(there)):
            client.create_flow_run_from_deployment(deployment.id)


def _drop_late_firings(ledger: FleetLedger, name: str) -> None:
    """Cancel firings that wait since before now: this one does what they would do."""
    from prefect.client.orchestration import get_client
    from prefect.states import Cancelled

    now = datetime.now(UTC)
    with get_client(sync_client=True) as client:
        for run in _runs(ledger, name, ("SCHEDULED",)):
            due = run.next_scheduled_start_time
            if "manifest" in run.parameters and due is not None and due < now:
                client.set_flow_run_state(run.id, Cancelled(message="another firing came first"))


def _runs(ledger: FleetLedger, name: str, types: tuple[str, ...]) -> "list[FlowRun]":
    return open_runs(ledger, types, fleet_tag(name))
