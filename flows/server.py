"""A Prefect server for one command, which ends with it however it ends.

Where the user has configured an API (`PREFECT_API_URL` or a profile), that one is used and nothing
is started. Prefect's own temporary server outlives a killed flow and writes to its output; this one
is told by the kernel when the flow's process is gone, and logs to a file.
"""

import http.client
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

from catalog.locks import held_lock

# prctl(PR_SET_PDEATHSIG): the kernel ends the child when its parent dies, even of SIGKILL
LAUNCHER = """
import ctypes, os, signal, sys
parent = int(sys.argv[1])
if sys.platform == "linux":
    ctypes.CDLL(None).prctl(1, signal.SIGTERM)
    if os.getppid() != parent:
        sys.exit(1)
os.execv(sys.executable, [sys.executable, *sys.argv[2:]])
"""
STARTUP_TIMEOUT_S = 120.0
STOP_TIMEOUT_S = 5.0
APPLICATION = "prefect.server.api.server:create_app"
SERVICES = (
    "CANCELLATION_CLEANUP",
    "CLEANUP_RECONCILER",
    "DB_VACUUM",
    "EVENT_LOGGER",
    "EVENT_PERSISTER",
    "FOREMAN",
    "LATE_RUNS",
    "PAUSE_EXPIRATIONS",
    "REPOSSESSOR",
    "SCHEDULER",
    "TASK_RUN_RECORDER",
    "TRIGGERS",
)
"""Services of the server for schedules, workers and its web page: one command has none of them."""


@contextmanager
def prefect_server(log_path: Path) -> Iterator[None]:
    """Run the block against the user's Prefect API, or against a server of its own.

    Raises:
        RuntimeError: the server does not start.
    """
    from prefect.settings import (
        PREFECT_API_URL,
        PREFECT_FLOWS_HEARTBEAT_FREQUENCY,
        PREFECT_HOME,
        PREFECT_LOGGING_TO_API_ENABLED,
        temporary_settings,
    )

    if PREFECT_API_URL.value():
        yield
        return
    log_path.parent.mkdir(parents=True, exist_ok=True)
    # two that make Prefect's database at once would break each other's tables
    with held_lock(PREFECT_HOME.value() / "lidarpainter-start.lock"):
        process, port = _started(log_path)
    try:
        # logs are sent in the background, perhaps after the server is gone
        own = {
            PREFECT_API_URL: f"http://127.0.0.1:{port}/api",
            PREFECT_LOGGING_TO_API_ENABLED: False,
            # nobody listens, and flows would end a second late
            PREFECT_FLOWS_HEARTBEAT_FREQUENCY: None,
        }
        with temporary_settings(own):
            yield
    except BaseException as error:
        if not isinstance(error, Exception):
            process.kill()  # whoever is interrupted waits for nobody
        raise
    finally:
        _stop(process)


def _started(log_path: Path) -> tuple[subprocess.Popen[bytes], int]:
    """A server that answers, and at which port."""
    port = _free_port()
    with log_path.open("ab") as log:
        process = _start(port, log.fileno())
    try:
        _wait_until_healthy(process, port, log_path)
    except BaseException:
        process.kill()
        process.wait()
        raise
    return process, port


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def _start(port: int, log: int) -> subprocess.Popen[bytes]:
    place = ["--host", "127.0.0.1", "--port", str(port)]
    arguments = ["--factory", APPLICATION, *place, "--log-level", "error", "--lifespan", "on"]
    environment = {
        **os.environ,
        "PREFECT_UI_ENABLED": "0",
        "PREFECT__SERVER_EPHEMERAL": "1",
        "PREFECT__SERVER_FINAL": "1",
        **{f"PREFECT_SERVER_SERVICES_{name}_ENABLED": "false" for name in SERVICES},
    }
    return start_child(["-m", "uvicorn", *arguments], log=log, environment=environment)


def _wait_until_healthy(process: subprocess.Popen[bytes], port: int, log_path: Path) -> None:
    deadline = time.monotonic() + STARTUP_TIMEOUT_S
    while time.monotonic() < deadline:
        if process.poll() is not None:
            break
        connection = http.client.HTTPConnection("127.0.0.1", port, timeout=5)
        try:
            connection.request("GET", "/api/health")
            if connection.getresponse().status == http.HTTPStatus.OK:
                return
        except OSError:
            time.sleep(0.1)
        finally:
            connection.close()
    raise RuntimeError(f"Prefect's server did not start; see {log_path}")


def _stop(process: subprocess.Popen[bytes]) -> None:
    process.send_signal(signal.SIGTERM)
    try:
        process.wait(STOP_TIMEOUT_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


def start_child(
    arguments: Sequence[str], *, log: int, environment: Mapping[str, str]
) -> subprocess.Popen[bytes]:
    """Start the interpreter with some arguments, for as long as this process lives.

    `log` is the descriptor of a file for what it has to say; `environment` is all of its own.
    """
    return subprocess.Popen(  # noqa: S603 - our own interpreter and arguments
        [sys.executable, "-c", LAUNCHER, str(os.getpid()), *arguments],
        stdin=subprocess.DEVNULL,
        stdout=log,
        stderr=log,
        env=dict(environment),
        start_new_session=True,  # Ctrl-C is for the command, which ends its children itself
    )
