"""One holder at a time, whoever dies, sleeps or comes back."""

import subprocess
import sys
from pathlib import Path

import pytest

from catalog.errors import CatalogError
from catalog.leases import FolderObjects, LeaseLostError, Leases

ROOT = Path(__file__).resolve().parents[2]
TAKER = """
import sys
from pathlib import Path
from catalog.leases import FolderObjects, Leases
assert Leases(FolderObjects(Path(sys.argv[1]))).take("a", above=6, facts={"scene_id": "x/y"})
"""


WAITER = """
import sys
from pathlib import Path
from catalog.leases import FolderObjects, Leases
folder = Path(sys.argv[1])
leases = Leases(FolderObjects(folder / "leases"))
for _ in range(5):
    with leases.alone("table"):
        count = folder / "count"
        before = int(count.read_text()) if count.exists() else 0
        count.write_text(str(before + 1))
"""


@pytest.fixture
def leases(tmp_path, clock):
    return Leases(FolderObjects(tmp_path), time_to_live_s=60.0, now=clock)


def test_a_lease_lives_by_its_heartbeat(leases, clock):
    lease = leases.take("a", above=0, facts={})
    clock.now += 50
    lease = leases.renew(lease, {"memory_bytes": 7})
    clock.now += 50
    assert not leases.has_expired(lease)
    assert leases.held()[0].facts == {"memory_bytes": 7}
    clock.now += 11
    assert leases.has_expired(lease)


def test_a_holder_that_slept_too_long_is_refused(leases, clock):
    late = leases.take("a", above=0, facts={})
    clock.now += 61
    assert leases.give_back(late)  # whoever reconciles
    new = leases.take("a", above=late.fence, facts={})
    with pytest.raises(LeaseLostError, match="number 1 was taken away"):
        leases.renew(late, {})
    assert not leases.give_back(late)
    assert leases.held() == [new]


def test_the_lease_of_a_dead_process_expires_at_once(tmp_path):
    subprocess.run([sys.executable, "-c", TAKER, tmp_path], cwd=ROOT, check=True)
    leases = Leases(FolderObjects(tmp_path))
    assert leases.has_expired(leases.held()[0])


@pytest.mark.parametrize("name", ["../a", "a/b", "", ".lock", "a\n", "x" * 200])
def test_a_name_that_leaves_the_folder_is_refused(leases, name):
    with pytest.raises(CatalogError, match="cannot name a lease"):
        leases.take(name, above=0, facts={})


@pytest.mark.parametrize("content", [b"", b"[]", b"{}", b'{"fence": 1, "holder": 3}', b"\xff"])
def test_a_damaged_lease_is_told_in_one_line(leases, tmp_path, content):
    (tmp_path / "a").write_bytes(content)
    with pytest.raises(CatalogError, match="the lease a is damaged"):
        leases.held()


def test_who_waits_for_a_lease_is_alone_with_it(tmp_path):
    words = [sys.executable, "-c", WAITER, tmp_path]
    processes = [subprocess.Popen(words, cwd=ROOT) for _ in range(4)]
    assert [process.wait() for process in processes] == [0] * 4
    assert (tmp_path / "count").read_text() == "20"
    assert Leases(FolderObjects(tmp_path / "leases")).held() == []


def test_a_lease_that_its_holder_left_behind_is_not_waited_for(leases, clock):
    lost = leases.take("table", above=0, facts={})
    clock.now += 2 * leases.time_to_live_s
    with leases.alone("table"):
        assert len(leases.held()) == 1
        with pytest.raises(LeaseLostError):
            leases.renew(lost, {})
    assert leases.held() == []


def test_who_waits_for_a_lease_is_told_once_who_holds_it(leases, monkeypatch):
    held, waits, told = leases.take("table", above=0, facts={}), [], []

    def sleep(_seconds):
        waits.append("a while")
        if len(waits) == 3:
            leases.give_back(held)

    monkeypatch.setattr("catalog.leases.time.sleep", sleep)
    with leases.alone("table", on_wait=told.append):
        assert told == [held.holder.name]
