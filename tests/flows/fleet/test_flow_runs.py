"""Where a Prefect API is configured, a sequence is one flow run there; else nothing is asked."""

import asyncio

import pytest

from flows.fleet.asked import Asked
from flows.fleet.work import Made, make_sequence
from lidarpainter_models.errors import SceneError

ASKED = Asked(dataset="synthetic", sequence="street-0007", seed=7, preset="preview")
MADE = Made(run_id="run", is_new=False, num_bytes=0)


@pytest.fixture
def flow_runs(prefect_api):  # noqa: ARG001 - the server
    """Names of the flow runs of sequences that Prefect knows, and how they ended."""
    from prefect.client.orchestration import get_client
    from prefect.client.schemas.filters import FlowFilter, FlowFilterName

    async def known():
        async with get_client() as client:
            named = FlowFilter(name=FlowFilterName(any_=["fleet-sequence"]))
            runs = await client.read_flow_runs(flow_filter=named)
        return sorted((run.name, run.state_name) for run in runs)

    return lambda: asyncio.run(known())


def test_a_sequence_is_a_flow_run_and_its_error_comes_back(flow_runs, tmp_path, monkeypatch):
    monkeypatch.setattr("flows.fleet.work._made", lambda *_: MADE)
    assert make_sequence(ASKED, tmp_path) == MADE

    def fail(*_):
        raise SceneError("the scene is damaged")

    monkeypatch.setattr("flows.fleet.work._made", fail)
    with pytest.raises(SceneError, match="the scene is damaged"):
        make_sequence(ASKED, tmp_path)
    assert flow_runs() == [(ASKED.scene_id, "Completed"), (ASKED.scene_id, "Failed")]


def test_without_an_api_no_flow_run_is_made(flow_runs, tmp_path, monkeypatch):
    from prefect.settings import PREFECT_API_URL, temporary_settings

    monkeypatch.setattr("flows.fleet.work._made", lambda *_: MADE)
    before = flow_runs()
    with temporary_settings({PREFECT_API_URL: None}):
        assert make_sequence(ASKED, tmp_path) == MADE
    assert flow_runs() == before
