"""PostgreSQL and a Prefect server as a fleet runs on them: real ones, on loopback, in a folder.

Nothing runs before `start`, so whoever made one can end it whatever comes in between.
"""

import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
import urllib.request
from contextlib import suppress
from pathlib import Path

import psutil

SCRIPTS = Path(__file__).resolve().parent
ROOT = SCRIPTS.parents[1]
BINARIES = sorted(Path("/usr/lib/postgresql").glob("*/bin"))
NO_POSTGRES = None if BINARIES else "Debian's postgresql is not installed"
START_S = 180.0
OWNER = "postgres"
"""Who PostgreSQL runs as where the tests are root, which it refuses to be."""


class Postgres:
    """A cluster of its own, on a Unix socket: nobody else can reach it, no password is needed."""

    PREFIX = "lidarpainter-postgres-"

    def __init__(self):
        self.folder = Path(tempfile.mkdtemp(prefix=self.PREFIX))
        self._user = OWNER if os.geteuid() == 0 else None
        if self._user:
            shutil.chown(self.folder, self._user)

    @property
    def url(self):
        return f"postgresql+asyncpg://{OWNER}@/prefect?host={self.folder}"

    def start(self):
        is_new = not self._data.exists()
        if is_new:
            self._call("initdb", "-D", self._data, "-A", "trust", "-U", OWNER, "--no-sync")
        options = f"-k {self.folder} -c listen_addresses='' -c fsync=off -c max_connections=60"
        log = self.folder / "log"
        self._call("pg_ctl", "-D", self._data, "-l", log, "-w", "-o", options, "start")
        if is_new:
            self._call("createdb", "-h", self.folder, "-U", OWNER, "prefect")

    def stop(self):
        self._call("pg_ctl", "-D", self._data, "-m", "immediate", "-w", "stop")

    def remove(self):
        """Also one that is stopped, or just about to start."""
        end_processes(self._data, signal.SIGQUIT)  # PostgreSQL's word for a stop at once
        shutil.rmtree(self.folder)

    @property
    def _data(self):
        return self.folder / "data"

    def _call(self, program, *words):
        subprocess.run(
            [BINARIES[-1] / program, *words],
            check=True,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            cwd=self.folder,
            user=self._user,
            start_new_session=True,  # Ctrl-C is for those who end it
        )


class PrefectService:
    """`prefect server start` over a PostgreSQL, with a home of its own."""

    def __init__(self, folder, database_url, **settings):
        self.folder = Path(folder)
        self.folder.mkdir(parents=True, exist_ok=True)
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            self._port = probe.getsockname()[1]
        self.url = f"http://127.0.0.1:{self._port}/api"
        self._database_url, self._settings = database_url, settings
        self._spawned = []

    @property
    def environment(self):
        """Of processes that use it."""
        kept = {name: value for name, value in os.environ.items() if "PREFECT" not in name}
        return {
            **kept,
            "PREFECT_HOME": str(self.folder),
            "PREFECT_API_URL": self.url,
            "PREFECT_SERVER_ANALYTICS_ENABLED": "false",
            "DO_NOT_TRACK": "1",
            "PYTHONPATH": ":".join([str(ROOT), str(SCRIPTS), kept.get("PYTHONPATH", "")]),
        }

    def start(self):
        environment = {
            **self.environment,
            **self._settings,
            "PREFECT_API_DATABASE_CONNECTION_URL": self._database_url,
            "PREFECT_UI_ENABLED": "0",
        }
        words = ["server", "start", "--host", "127.0.0.1", "--port", str(self._port), "--no-ui"]
        self.process = self.spawn(words, "server", environment)
        deadline = time.monotonic() + START_S
        while not answers(self.url):
            assert self.process.poll() is None, f"see {self.folder / 'server.log'}"
            assert time.monotonic() < deadline, f"see {self.folder / 'server.log'}"
            time.sleep(0.5)

    def spawn(self, words, name, environment=None):
        """`prefect ...` with a log and a session of its own, until `end`."""
        with (self.folder / f"{name}.log").open("ab") as log:
            process = subprocess.Popen(
                [sys.executable, "-m", "prefect", *words],
                stdout=log,
                stderr=log,
                env=environment or self.environment,
                cwd=self.folder,
                start_new_session=True,
            )
        self._spawned.append(process)
        return process

    def kill(self):
        self.process.kill()
        self.process.wait()

    def end(self):
        """The server, process workers, and flows that they left behind."""
        end_processes(self.folder, signal.SIGKILL)
        for process in self._spawned:
            process.wait()


def answers(api):
    """Whether a Prefect API is in health."""
    try:
        with urllib.request.urlopen(f"{api}/health", timeout=5) as answer:  # noqa: S310 - our own
            return answer.status == 200
    except OSError:
        return False


def end_processes(folder, number):
    """Send a signal to all processes whose words or environment name a folder, until none is left.

    So orphans in sessions of their own are found too.
    """
    while found := [process for process in psutil.process_iter() if _names(process, folder)]:
        for process in found:
            with suppress(psutil.NoSuchProcess):
                process.send_signal(number)
        time.sleep(0.1)


def _names(process, folder):
    with suppress(psutil.Error):  # it is gone by now, or somebody else's
        words = (*process.cmdline(), *process.environ().values())
        return any(str(folder) in word for word in words)
    return False
