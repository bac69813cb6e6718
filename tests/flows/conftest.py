"""One tiny street through the whole pipeline, once for all tests of the flows."""

import shutil
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pytest
from commands import settings, succeed
from tiny_street import SEED, SETTINGS, tiny_street

from catalog.store import Store, open_store
from flows.environment import prepare_environment

TABLES = ("scenes", "runs", "artefacts", "metrics", "painters")


@dataclass(frozen=True)
class TinyRun:
    """What `lidarpainter demo --json` left behind."""

    store: Store
    out: Path
    result: dict[str, Any]
    progress: str
    """What it said on stderr."""
    rows: dict[str, list[dict[str, Any]]]
    """Every table of the catalog right after it."""

    @property
    def run_id(self) -> str:
        return self.result["run_id"]


@pytest.fixture(scope="package")
def prefect_api(tmp_path_factory):
    """One Prefect server for every flow: a process does not survive a second one."""
    folder = tmp_path_factory.mktemp("prefect")
    with pytest.MonkeyPatch.context() as patched:
        patched.setenv("PREFECT_HOME", str(folder))
        prepare_environment()
        from flows.server import prefect_server

        with prefect_server(folder / "server.log"):
            yield


@pytest.fixture
def client(prefect_api):  # noqa: ARG001 - the server
    """A client of that server."""
    from prefect.client.orchestration import get_client

    with get_client(sync_client=True) as found:
        yield found


@pytest.fixture(scope="package")
def tiny_run(
    prefect_api: None,  # noqa: ARG001 - flows find it where Prefect looks
    tmp_path_factory: pytest.TempPathFactory,
) -> TinyRun:
    """The demo on a tiny street: ingested, fitted, painted, fitted on, judged, reported."""
    out = tmp_path_factory.mktemp("demo")
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr("flows.demo.demo_street", tiny_street)
        answer = succeed("demo", "--seed", SEED, "--out", out, "--json", *settings(*SETTINGS))
    store = open_store(out / "store")
    rows = {table: store.tables.rows(table) for table in TABLES}
    return TinyRun(store, out, answer.json, answer.err, rows)


@pytest.fixture(scope="module")
def own_run(tiny_run: TinyRun, tmp_path_factory: pytest.TempPathFactory) -> TinyRun:
    """The tiny run in a store that others do not see: what is made of it is nobody's latest run."""
    root = tmp_path_factory.mktemp("own") / "store"
    shutil.copytree(tiny_run.store.root, root)
    return replace(tiny_run, store=open_store(root))
