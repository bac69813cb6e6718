"""A fleet in Prefect's hands: a work pool of processes, and what it runs there.

A firing is short. It enters what is new, closes what nobody works on any more, and sees to it that
there are as many workers as are wanted, so whatever was killed since the last one is replaced. A
worker is one flow run that makes one sequence after the other: a process for each sequence would
pay eight seconds of imports, and a queue of thousands starves (see `flow_runs`).

The pool has no concurrency limit and neither have the two deployments: slots of those are lost with
whoever held them (Prefect issues 17415, 19403). How much runs at once is said by the workers that
are wanted, and by `prefect worker start --limit`.
"""

from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from prefect import flow, get_run_logger
from prefect.runtime import flow_run as this_run
from pydantic import ValidationError

from catalog.errors import CatalogError
from catalog.fleets import FleetLedger
from catalog.store import open_store
from flows.environment import THREADS, prepare_environment
from flows.fleet.asked_sequences import wishes
from flows.fleet.flow_runs import FIRING, WORK, api_lost, close_lost_runs, open_runs, store_tag
from flows.fleet.limits import lacks_disk, over_budget
from flows.fleet.local_workers import THREAD_COUNTS
from flows.fleet.manifest import Budget, read_manifest
from flows.fleet.status import counts_of
from flows.fleet.work import make_sequence
from flows.fleet.worker import Worker
from lidarpainter_models.errors import ConfigError

if TYPE_CHECKING:
    from prefect.client.orchestration import SyncPrefectClient
    from prefect.client.schemas.actions import DeploymentScheduleCreate

POOL = "lidarpainter"
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
    with ledger.flow_runs.kept(this_run.id):
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
    with ledger.flow_runs.kept(this_run.id):
        Worker(ledger=ledger, fleet=fleet, work=make_sequence, say=get_run_logger().info).run()


def fleet_tag(name: str) -> str:
    """The tag of every firing and worker of a fleet."""
    return f"fleet:{name}"


def _start_workers(ledger: FleetLedger, name: str, wanted: int) -> None:
    """Ask for the workers that are neither at work nor on their way."""
    from prefect.client.orchestration import get_client

    there = [run for run in open_runs(ledger, OPEN, fleet_tag(name)) if "fleet" in run.parameters]
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
        for run in open_runs(ledger, ("SCHEDULED",), fleet_tag(name)):
            due = run.next_scheduled_start_time
            if "manifest" in run.parameters and due is not None and due < now:
                client.set_flow_run_state(run.id, Cancelled(message="another firing came first"))


def deploy(
    name: str, parameters: dict[str, Any], *, pool: str, cron: str | None, threads: int = 1
) -> dict[str, Any]:
    """Make or update the pool and the deployments of a fleet; without a schedule, fire once.

    `parameters` are those of `fleet`; the pool is of type process, made if it is not
    there; `cron` is in UTC; `threads` are those of each worker.

    Returns:
        What `fleet run --deploy --json` prints.

    Raises:
        ConfigError: no API is configured, the schedule is none, the pool is of another type, or a
            fleet of this name is deployed for another store.
        CatalogError: the API does not answer.
    """
    from prefect.client.orchestration import get_client
    from prefect.settings import PREFECT_API_URL

    if not PREFECT_API_URL.value():
        raise ConfigError("--deploy: expected PREFECT_API_URL to name the API of a Prefect server")
    if lost := api_lost():
        raise CatalogError(lost)
    store, schedules = parameters["store"], [] if cron is None else [_schedule(cron)]
    named = [store_tag(store), fleet_tag(name)]
    with get_client(sync_client=True) as client:
        _require_own_store(client, name, store)
        _make_pool(client, pool)
        common: dict[str, Any] = {"name": name, "work_pool_name": pool, "tags": named}
        env = {**THREADS, **dict.fromkeys(THREAD_COUNTS, str(threads))}
        client.create_deployment(
            flow_id=client.create_flow_from_name(fleet_work.name),
            entrypoint=f"{__name__}.{fleet_work.fn.__name__}",
            parameters={"fleet": name, "store": store},
            job_variables={"env": env},
            **common,
        )
        firing = client.create_deployment(
            flow_id=client.create_flow_from_name(fleet.name),
            entrypoint=f"{__name__}.{fleet.fn.__name__}",
            parameters=parameters,
            schedules=schedules,
            **common,
        )
        if cron is None:
            client.create_flow_run_from_deployment(firing)
    return {
        "fleet": name,
        "pool": pool,
        "deployment": f"{fleet.name}/{name}",
        "cron": cron,
        "worker": f"prefect worker start --pool {pool} --limit {parameters['workers'] + 1}",
    }


def _schedule(cron: str) -> "DeploymentScheduleCreate":
    from prefect.client.schemas.actions import DeploymentScheduleCreate
    from prefect.client.schemas.schedules import CronSchedule

    try:
        return DeploymentScheduleCreate(schedule=CronSchedule(cron=cron))
    except ValidationError:
        raise ConfigError(
            f"--cron {cron!r}: expected minute, hour, day, month and weekday such as */15 * * * *"
        ) from None


def _require_own_store(client: "SyncPrefectClient", name: str, store: str) -> None:
    from prefect.exceptions import ObjectNotFound

    try:
        known = client.read_deployment_by_name(f"{fleet.name}/{name}").parameters["store"]
    except ObjectNotFound:
        return
    if known != store:
        raise ConfigError(
            f"fleet {name} is deployed for the store {known}: delete that deployment "
            f"(`prefect deployment delete {fleet.name}/{name}`), or name this fleet otherwise"
        )


def _make_pool(client: "SyncPrefectClient", name: str) -> None:
    from prefect.client.schemas.actions import WorkPoolCreate
    from prefect.exceptions import ObjectNotFound
    from prefect.workers.process import ProcessWorker

    try:
        found = client.read_work_pool(name)
    except ObjectNotFound:
        template = ProcessWorker.get_default_base_job_template()
        client.create_work_pool(
            WorkPoolCreate(name=name, type=ProcessWorker.type, base_job_template=template)
        )
        return
    if found.type != ProcessWorker.type:
        raise ConfigError(f"--pool {name}: expected one of type process, it is {found.type}")
