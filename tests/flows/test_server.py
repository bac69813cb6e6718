"""The flow's own Prefect server ends with the flow."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from production_services import answers
from waiting import until

PROXIES = dict.fromkeys(("http_proxy", "https_proxy", "all_proxy"), "http://127.0.0.1:9")
ROOT = Path(__file__).resolve().parents[2]
FLOW = """
import sys, time
from pathlib import Path
from flows.environment import prepare_environment
prepare_environment()
from flows import server
from prefect import flow
from prefect.settings import PREFECT_API_URL

@flow
def work(seconds):
    print(PREFECT_API_URL.value(), flush=True)
    time.sleep(seconds)
    return 7

with server.prefect_server(Path(sys.argv[1])):
    print(work(float(sys.argv[2])), flush=True)
"""


def start_flow(tmp_path, seconds):
    """Start a flow in a process of its own, on a machine behind a proxy."""
    environment = {**os.environ, **PROXIES, "PREFECT_HOME": str(tmp_path / "prefect")}
    for name in ("PREFECT_API_URL", "no_proxy", "NO_PROXY"):
        environment.pop(name, None)
    return subprocess.Popen(
        [sys.executable, "-c", FLOW, str(tmp_path / "server.log"), str(seconds)],
        stdout=subprocess.PIPE,
        text=True,
        cwd=ROOT,
        env=environment,
    )


@pytest.mark.slow
def test_a_flow_runs_against_its_own_server_and_takes_it_along(tmp_path):
    flow = start_flow(tmp_path, 0)
    api, found = flow.communicate(timeout=120)[0].split()
    assert found == "7"
    assert not answers(api)


@pytest.mark.slow
def test_two_flows_may_begin_at_once_where_prefect_was_never_used(tmp_path):
    flows = [start_flow(tmp_path, 0) for _ in range(2)]
    assert [flow.communicate(timeout=240)[0].split()[1] for flow in flows] == ["7", "7"]


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="parent-death signals are Linux's")
def test_a_killed_flow_leaves_no_server_behind(tmp_path):
    flow = start_flow(tmp_path, 60)
    api = flow.stdout.readline().strip()
    assert answers(api)
    flow.send_signal(signal.SIGKILL)
    flow.communicate()
    until(lambda: not answers(api), seconds=10)
