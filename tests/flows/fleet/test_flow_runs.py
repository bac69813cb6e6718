"""A sequence is one flow run where a Prefect API is configured, and none is left open."""

import urllib.error

import httpx
import pytest
from stub_fleet import asked_ledger, stub_ledger, stub_worker, write_stub_manifest

from catalog.leases import FolderObjects, Leases
from catalog.retries import attempt_id
from flows.fleet import flow_runs as flow_runs_module
from flows.fleet.asked_sequences import Asked
from flows.fleet.flow_runs import (
    SEQUENCE,
    WORK,
    ApiLostError,
    api_lost,
    close_lost_runs,
    is_of_lost_api,
    store_tag,
)
from flows.fleet.work import Made, make_sequence
from lidarpainter_models.errors import SceneError

ASKED = Asked(dataset="synthetic", sequence="street-0007", seed=7, preset="preview")
MADE = Made(run_id="run", is_whole=False, num_bytes=0)


@pytest.fixture
def states(client, tmp_path):
    """Names of the flow runs that work on a store, and how they stand."""
    from prefect.client.schemas.filters import FlowRunFilter, FlowRunFilterTags

    def known():
        tags = FlowRunFilterTags(all_=[store_tag(tmp_path)])
        runs = client.read_flow_runs(flow_run_filter=FlowRunFilter(tags=tags))
        return sorted((run.name, run.state_name) for run in runs)

    return known


def test_a_sequence_is_a_flow_run_and_its_error_comes_back(states, tmp_path, monkeypatch):
    monkeypatch.setattr("flows.fleet.work._made", lambda *_: MADE)
    assert make_sequence(ASKED, tmp_path, "a-1") == MADE

    def fail(*_):
        raise SceneError("the scene is damaged")

    monkeypatch.setattr("flows.fleet.work._made", fail)
    with pytest.raises(SceneError, match="the scene is damaged"):
        make_sequence(ASKED, tmp_path, "a-2")
    assert states() == [(ASKED.scene_id, "Completed"), (ASKED.scene_id, "Failed")]


def test_without_an_api_no_flow_run_is_made(states, tmp_path, monkeypatch):
    from prefect.settings import PREFECT_API_URL, temporary_settings

    monkeypatch.setattr("flows.fleet.work._made", lambda *_: MADE)
    with temporary_settings({PREFECT_API_URL: None}):
        assert make_sequence(ASKED, tmp_path, "a-1") == MADE
        assert api_lost() is None
    assert states() == []


def test_what_nobody_works_on_is_closed_and_gives_back_its_slot(
    client, states, tmp_path, monkeypatch
):
    from prefect import flow
    from prefect.states import Pending, Running

    monkeypatch.setattr(flow_runs_module, "BEGIN_S", 0.0)
    ledger = stub_ledger(tmp_path)
    lease = ledger.leases.take("sequence", above=4, facts={})
    tags = [store_tag(tmp_path)]

    def begun(name, attempt, state):
        made = flow(lambda attempt: attempt, name=SEQUENCE)
        return client.create_flow_run(
            made, name=name, parameters={"attempt": attempt}, state=state, tags=tags
        )

    begun("in hand", attempt_id(lease), Running())
    begun("of before", "sequence-4", Running())
    begun("never began", "sequence-3", Pending())
    deployment = client.create_deployment(
        client.create_flow_from_name(WORK), "stub", concurrency_limit=1, tags=tags
    )
    worker, lost = (client.create_flow_run_from_deployment(deployment, name=n) for n in "ab")
    with ledger.flow_runs.kept(str(worker.id)):
        client.set_flow_run_state(worker.id, Running(), force=True)
        client.set_flow_run_state(lost.id, Pending())
        limit = client.read_deployment(deployment).global_concurrency_limit.name
        assert client.read_global_concurrency_limit_by_name(limit).active_slots == 1
        closed = close_lost_runs(ledger)
    assert client.read_global_concurrency_limit_by_name(limit).active_slots == 0
    assert sorted(closed) == [
        "flow run b was Pending and is closed",
        "flow run never began was Pending and is closed",
        "flow run of before was Running and is closed",
    ]
    assert states() == [
        ("a", "Running"),
        ("b", "Crashed"),
        ("in hand", "Running"),
        ("never began", "Crashed"),
        ("of before", "Crashed"),
    ]


def test_a_run_that_has_ended_stays_as_it_ended(client, states, tmp_path, monkeypatch):
    from prefect import flow
    from prefect.states import Completed, Running

    ledger = stub_ledger(tmp_path)
    made = flow(lambda attempt: attempt, name=SEQUENCE)
    run = client.create_flow_run(
        made, name="x", parameters={"attempt": "a-1"}, state=Running(), tags=[store_tag(tmp_path)]
    )
    listed = flow_runs_module.open_runs(ledger, ("RUNNING",))
    client.set_flow_run_state(run.id, Completed())
    monkeypatch.setattr(flow_runs_module, "open_runs", lambda *_: listed)
    close_lost_runs(ledger)
    assert states() == [("x", "Completed")]


def test_a_lease_of_a_gone_flow_run_goes(client, tmp_path):  # noqa: ARG001 - the server
    now = [1000.0]
    ledger = stub_ledger(tmp_path)
    ledger.flow_runs = Leases(FolderObjects(tmp_path / "flow-runs"), now=lambda: now[0])
    ledger.flow_runs.take("run", above=0, facts={})
    close_lost_runs(ledger)
    assert len(ledger.flow_runs.held()) == 1
    now[0] += 500.0
    close_lost_runs(ledger)
    assert ledger.flow_runs.held() == []


def test_a_lost_api_is_known_by_its_errors():
    request = httpx.Request("GET", "http://127.0.0.1:1/api")
    refused = httpx.ConnectError("refused")
    for status, is_lost in ((503, True), (500, True), (404, False), (409, False)):
        answer = httpx.Response(status, request=request)
        assert is_of_lost_api(httpx.HTTPStatusError("x", request=request, response=answer)) is (
            is_lost
        )
    wrapped = RuntimeError("Failed to reach API")
    wrapped.__context__ = refused  # as Prefect raises it
    assert is_of_lost_api(wrapped)
    assert not is_of_lost_api(ConnectionResetError("of a bucket"))
    assert not is_of_lost_api(None)


def test_a_lost_api_pauses_the_fleet_and_costs_no_tries(tmp_path, monkeypatch):
    """The API goes as the first sequence begins, and comes back after two looks."""
    path = write_stub_manifest(tmp_path, sequences=2)
    ledger = asked_ledger(tmp_path / "store", path)
    lines, begun, away = [], [], [0]
    worker = stub_worker(ledger.store.root, "stub", say=lines.append)
    work = worker.work

    def lost_once(asked, store, attempt):
        begun.append(attempt)
        if len(begun) == 1:
            away[0] = 2
            raise ApiLostError("Prefect's API does not answer")
        return work(asked, store, attempt)

    def looked(*_args, **_options):
        if away[0]:
            away[0] -= 1
            raise urllib.error.URLError(ConnectionRefusedError(111, "Connection refused"))
        return open(path)  # noqa: PTH123 - whatever closes

    from prefect.settings import PREFECT_API_URL, temporary_settings

    worker.work = lost_once
    monkeypatch.setattr(flow_runs_module, "urlopen", looked)
    with temporary_settings({PREFECT_API_URL: "http://127.0.0.1:1/api"}):
        worker.run()
    rows = ledger.rows("stub")
    assert [(row["state"], row["tries"], row["attempts"]) for row in rows] == [
        ("done", 0, 2),
        ("done", 0, 1),
    ]
    assert sum(line.startswith("paused: Prefect's API") for line in lines) == 1
    assert any("api-lost after" in line for line in lines)
