"""A lock keeps others out for as long as its holder lives."""

import fcntl
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from catalog.errors import StorageError
from catalog.locks import held_lock

ROOT = Path(__file__).resolve().parents[2]
HOLDER = """
import sys, time
from pathlib import Path
from catalog.locks import held_lock
with held_lock(Path(sys.argv[1])):
    print("held", flush=True)
    time.sleep(60)
"""


def is_locked(path):
    with path.open() as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return True
    return False


def test_a_lock_is_held_inside_the_block_only(tmp_path):
    path = tmp_path / "locks" / "a.lock"
    with held_lock(path) as waited:
        assert not waited
        assert is_locked(path)
    assert not is_locked(path)


def test_threads_of_one_process_exclude_each_other(tmp_path):
    inside, most = [], []

    def work():
        with held_lock(tmp_path / "a.lock"):
            inside.append(1)
            most.append(len(inside))
            inside.pop()

    threads = [threading.Thread(target=work) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert most == [1] * 8


def test_a_killed_holder_lets_go_and_the_waiter_is_told_who_held(tmp_path):
    path = tmp_path / "a.lock"
    holder = subprocess.Popen(
        [sys.executable, "-c", HOLDER, str(path)], stdout=subprocess.PIPE, text=True, cwd=ROOT
    )
    assert holder.stdout.readline() == "held\n"
    holders = []

    def kill(process_id):
        holders.append(process_id)
        holder.kill()

    with held_lock(path, on_wait=kill) as waited:
        assert waited
    holder.communicate()
    assert holders == [str(holder.pid)]


def test_a_lock_that_cannot_be_made_is_a_storage_error(tmp_path):
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(StorageError, match="cannot lock"), held_lock(tmp_path / "file" / "a.lock"):
        pass
