"""The flow's own Prefect server ends with the flow."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from flows.environment import prepare_environment

ROOT = Path(__file__).resolve().parents[2]
FLOW = """
import sys, time
from pathlib import Path
from flows.environment import prepare_environment
prepare_environment(is_quiet=True)
from flows import server
from prefect import flow

started = server._start
def remember(port, log):
    process = started(port, log)
    print(process.pid, flush=True)
    return process
server._start = remember

@flow
def work(seconds):
    print("working", flush=True)
    time.sleep(seconds)
    return 7

with server.prefect_server(Path(sys.argv[1])):
    print(work(float(sys.argv[2])), flush=True)
"""


def is_alive(process_id: int) -> bool:
    try:
        os.kill(process_id, 0)
    except ProcessLookupError:
        return False
    return "Z" not in Path(f"/proc/{process_id}/stat").read_text().split()[2]


def start_flow(tmp_path, seconds):
    environment = {**os.environ, "PREFECT_HOME": str(tmp_path / "prefect")}
    environment.pop("PREFECT_API_URL", None)
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
    lines = flow.communicate(timeout=120)[0].splitlines()
    assert lines[1:] == ["working", "7"]
    assert not is_alive(int(lines[0]))


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="parent-death signals are Linux's")
def test_a_killed_flow_leaves_no_server_behind(tmp_path):
    flow = start_flow(tmp_path, 60)
    server_id = int(flow.stdout.readline())
    assert flow.stdout.readline() == "working\n"
    assert is_alive(server_id)
    flow.send_signal(signal.SIGKILL)
    flow.communicate()
    deadline = time.monotonic() + 10
    while is_alive(server_id):
        assert time.monotonic() < deadline
        time.sleep(0.1)


def test_what_the_user_set_stays(monkeypatch):
    monkeypatch.setenv("OMP_WAIT_POLICY", "active")
    monkeypatch.delenv("DO_NOT_TRACK", raising=False)
    monkeypatch.setenv("PREFECT_LOGGING_LEVEL", "DEBUG")
    prepare_environment(is_quiet=True)
    assert os.environ["OMP_WAIT_POLICY"] == "active"
    assert os.environ["PREFECT_LOGGING_LEVEL"] == "DEBUG"
    assert os.environ["DO_NOT_TRACK"] == "1"
