"""Puts a fleet into Prefect's hands: a work pool of processes, and two deployments.

The pool has no concurrency limit and neither have the deployments: slots of those are lost with
whoever held them (Prefect issues 17415, 19403). How much runs at once is said by the workers that
are wanted, and by `prefect worker start --limit`.
"""

from typing import TYPE_CHECKING, Any

from pydantic import ValidationError

from catalog.errors import CatalogError
from flows.environment import THREADS
from flows.fleet.deployed import fleet, fleet_tag, fleet_work
from flows.fleet.flow_runs import api_lost, store_tag
from flows.fleet.local_workers import THREAD_COUNTS
from lidarpainter_models.errors import ConfigError

if TYPE_CHECKING:
    from prefect.client.orchestration import SyncPrefectClient
    from prefect.client.schemas.actions import DeploymentScheduleCreate

POOL = "lidarpainter"
MODULE = "flows.fleet.deployed"


def deploy(
    name: str, parameters: dict[str, Any], *, pool: str, cron: str | None, threads: int = 1
) -> dict[str, Any]:
    """Make or update the pool and the deployments of a fleet; without a schedule, fire once.

    `parameters` are those of `deployed.fleet`; the pool is of type process, made if it is not
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
            entrypoint=f"{MODULE}.{fleet_work.fn.__name__}",
            parameters={"fleet": name, "store": store},
            job_variables={"env": env},
            **common,
        )
        firing = client.create_deployment(
            flow_id=client.create_flow_from_name(fleet.name),
            entrypoint=f"{MODULE}.{fleet.fn.__name__}",
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
