"""Whatever is killed, restarted or filled: afterwards everything is there, once."""

import os
import signal
import subprocess
import sys
import tempfile
import time
from contextlib import suppress
from pathlib import Path

import psutil
import pytest
import run_chaos
from production_services import NO_POSTGRES, end_processes

needs_postgres = pytest.mark.skipif(NO_POSTGRES is not None, reason=str(NO_POSTGRES))
LONGEST_S = 300.0


@pytest.mark.slow
@needs_postgres
def test_a_fleet_survives_its_kills():
    """Thirty kills of a hundred sequences, for an hour: `python tests/chaos/run_chaos.py`."""
    found = run_chaos.run_chaos(sequences=24, corrupted=3, kills=10, seed=0, pace_s=1.0)
    assert found["wrong"] == []


@pytest.fixture
def open_folder():
    """PostgreSQL runs as another user, whom pytest's folders keep out."""
    with tempfile.TemporaryDirectory() as name:
        Path(name).chmod(0o755)
        yield Path(name)


@needs_postgres
@pytest.mark.parametrize(
    "number", [signal.SIGTERM, pytest.param(signal.SIGINT, marks=pytest.mark.slow)]
)
def test_a_signal_ends_all_that_chaos_started(number, open_folder):
    words = [sys.executable, run_chaos.__file__, "--sequences", "2", "--corrupted", "1"]
    environment = os.environ | {"TMPDIR": str(open_folder)}
    with subprocess.Popen(words, env=environment) as chaos:
        try:
            wait_until(lambda: "prefect server start" in words_below(open_folder))
            assert "bin/postgres" in words_below(open_folder)
            chaos.send_signal(number)
            assert chaos.wait(LONGEST_S) == 128 + number
            assert words_below(open_folder) == ""
            assert not [*open_folder.glob("lidarpainter-postgres-*")]
            assert not [path for path in open_folder.glob("*/disk") if path.is_mount()]
        finally:
            chaos.terminate()


def test_who_was_left_behind_in_a_session_of_its_own_is_ended(tmp_path):
    environment = {"PREFECT_HOME": str(tmp_path / "prefect")}
    words = ["sh", "-c", "sleep 600 & sleep 600 & wait"]
    with subprocess.Popen(words, env=environment, start_new_session=True) as parent:
        wait_until(lambda: words_below(tmp_path).count("sleep 600\n") == 2)
        parent.kill()
        end_processes(tmp_path, signal.SIGKILL)
    assert words_below(tmp_path) == ""


def words_below(folder):
    """Command lines of the processes whose words or environment name something in a folder."""
    found = ""
    for process in psutil.process_iter():
        with suppress(psutil.Error):
            words = process.cmdline()
            if any(f"{folder}/" in word for word in (*words, *process.environ().values())):
                found += " ".join(words) + "\n"
    return found


def wait_until(happens):
    deadline = time.monotonic() + LONGEST_S
    while not happens():
        assert time.monotonic() < deadline, "it did not happen"
        time.sleep(0.1)
