"""What Prefect shows of fleets, held to what the store says.

A worker process that dies leaves its flow runs Running or Pending for ever (Prefect issue 16746),
with the slots that they hold. Here a run is alive as long as a live lease bears its number, and
whatever else is open is closed. The server refuses to make a run that has ended a crashed one, so
a run that ends just now stays as it ended.
"""

import http.client
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.error import HTTPError, URLError
from urllib.request import Request, urlopen

import httpx

from catalog.errors import CatalogError
from catalog.fleets import FleetLedger
from catalog.leases import Lease, Leases
from catalog.retries import attempt_id

if TYPE_CHECKING:
    from prefect.client.schemas.objects import FlowRun

SEQUENCE, WORK, FIRING = "fleet-sequence", "fleet-work", "fleet"
"""Names of flows: one sequence, a worker, a look at the manifest."""
MOST_READ = 200
"""Flow runs that the server lists at once."""
ANSWER_S = 10.0
BEGIN_S = 300.0
"""How long the process of a flow run may take from its last state to its first sign of life."""
LOST = "nobody works on it any more: no live lease bears its number"


class ApiLostError(CatalogError):
    """Prefect's API is configured and does not answer."""


def store_tag(store: Path | str) -> str:
    """The tag of every flow run that works on a store; several stores may share one server."""
    return f"store:{Path(store)}"


def api_lost() -> str | None:
    """Why nothing may begin: an API is configured and does not answer; None if all is well."""
    from prefect.settings import PREFECT_API_URL

    url = PREFECT_API_URL.value()
    if not url:
        return None
    try:
        with urlopen(Request(f"{url}/ready"), timeout=ANSWER_S):  # noqa: S310 - as configured
            return None
    except HTTPError as error:
        if error.code < http.HTTPStatus.INTERNAL_SERVER_ERROR:
            return None  # whoever wants to know who asks is there
        return f"Prefect's API {url} answers {error.code}"
    except (URLError, OSError, http.client.HTTPException) as error:
        return f"Prefect's API {url} does not answer: {getattr(error, 'reason', error)}"


def is_of_lost_api(error: BaseException | None) -> bool:
    """Whether an error came about because Prefect's API was away, or its database."""
    while error is not None:
        if isinstance(error, (httpx.TransportError, ApiLostError)):
            return True
        if isinstance(error, httpx.HTTPStatusError) and error.response.is_server_error:
            return True
        error = error.__cause__ or error.__context__
    return False


def close_lost_runs(ledger: FleetLedger) -> list[str]:
    """Close the flow runs of a store that nobody works on; returns a line for each.

    A closed run gives back the slots that it held. Runs are listed before leases are: what begins
    meanwhile is not among them.

    Raises:
        ApiLostError: the API does not answer.
    """
    from prefect.client.orchestration import get_client
    from prefect.states import Crashed

    with _api_errors(), get_client(sync_client=True) as client:
        runs = open_runs(ledger, ("PENDING", "RUNNING", "CANCELLING", "PAUSED"))
        lost = _lost_among(runs, ledger)
        for run in lost:
            client.set_flow_run_state(run.id, Crashed(message=LOST))
    return [f"flow run {run.name} was {run.state_name} and is closed" for run in lost]


def open_runs(ledger: FleetLedger, types: tuple[str, ...], *tags: str) -> "list[FlowRun]":
    """Flow runs of a store in states of some types, oldest first, `MOST_READ` at most."""
    from prefect.client.orchestration import get_client
    from prefect.client.schemas.filters import (
        FlowRunFilter,
        FlowRunFilterState,
        FlowRunFilterStateType,
        FlowRunFilterTags,
    )
    from prefect.client.schemas.objects import StateType
    from prefect.client.schemas.sorting import FlowRunSort

    state = FlowRunFilterStateType(any_=[StateType(one) for one in types])
    chosen = FlowRunFilter(
        state=FlowRunFilterState(type=state),
        tags=FlowRunFilterTags(all_=[store_tag(ledger.store.address), *tags]),
    )
    with _api_errors(), get_client(sync_client=True) as client:
        return client.read_flow_runs(
            flow_run_filter=chosen, sort=FlowRunSort.EXPECTED_START_TIME_ASC, limit=MOST_READ
        )


def _lost_among(runs: "list[FlowRun]", ledger: FleetLedger) -> "list[FlowRun]":
    others = ledger.flow_runs
    attempts = {attempt_id(lease) for lease in _live(ledger.leases)}
    at_work = attempts | {lease.name for lease in _live(others)}
    long_ago = datetime.now(UTC) - timedelta(seconds=BEGIN_S)

    def is_lost(run: "FlowRun") -> bool:
        if "attempt" in run.parameters:  # its lease was taken before it began
            return run.parameters["attempt"] not in at_work
        is_new = run.state is not None and run.state.timestamp > long_ago
        return str(run.id) not in at_work and not is_new

    for lease in others.held():
        if others.has_expired(lease):
            others.give_back(lease)
    return [run for run in runs if is_lost(run)]


def _live(leases: Leases) -> Iterator[Lease]:
    return (lease for lease in leases.held() if not leases.has_expired(lease))


@contextmanager
def _api_errors() -> Iterator[None]:
    try:
        yield
    except Exception as error:
        if is_of_lost_api(error):
            raise ApiLostError(f"Prefect's API does not answer: {error}") from error
        raise
