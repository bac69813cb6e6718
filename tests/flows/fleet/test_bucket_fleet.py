"""A fleet whose store is a bucket: it goes on when the bucket is back."""

from pathlib import Path

import pytest
from small_pandaset import PandasetFolder
from stub_fleet import asked_ledger, stub_ledger, stub_worker, write_stub_manifest

from catalog import buckets
from catalog.buckets import Bucket
from catalog.store import open_store
from flows.fleet.asked_sequences import Asked, wishes
from flows.fleet.limits import lacks_disk
from flows.fleet.local_workers import run_workers
from flows.fleet.manifest import Budget, read_manifest
from flows.fleet.metrics_file import write_metrics
from flows.interruption import Interrupted
from lidarpainter_models.errors import DataError
from tasks.ingest.bucket_roots import root_at_hand
from tasks.ingest.jobs import IngestRequest, ingest_or_recall


@pytest.fixture
def impatient(monkeypatch):
    monkeypatch.setattr(buckets, "RETRIES", 0)


@pytest.fixture
def asked(address, tmp_path):
    return asked_ledger(address, write_stub_manifest(tmp_path, sequences=2))


def test_a_log_in_a_bucket_is_fetched_read_and_let_go(address, tmp_path, monkeypatch):
    log = PandasetFolder(tmp_path / "logs")
    log.write_log()
    logs = Bucket(f"{address}/logs")
    for path in log.path.rglob("*"):
        if path.is_file():
            logs.upload(path.relative_to(tmp_path / "logs").as_posix(), path)
    manifest = tmp_path / "night.toml"
    source = f'[[source]]\ndataset = "pandaset"\nroot = "{logs.address}"\n'
    manifest.write_text(f'name = "stub"\n{source}[budget]\nfree_disk_gb = 0\n')
    (wish,) = wishes(read_manifest(manifest), tmp_path)
    asked = Asked.model_validate_json(wish.asked)
    store = open_store(tmp_path / "store")
    request = IngestRequest(store.address, asked.dataset, asked.root, None, None)
    row = ingest_or_recall(request, asked.sequence, again=False)
    assert row["scene_id"] == wish.scene_id
    assert list((tmp_path / "cache").glob("dataset-*")) == []
    monkeypatch.setattr("tasks.ingest.jobs.ingest_sequence", None)  # it is not read again
    assert ingest_or_recall(request, asked.sequence, again=False) == row


def test_a_log_that_goes_while_it_is_fetched_is_one_line(address, tmp_path, monkeypatch):
    logs = Bucket(f"{address}/logs")
    (tmp_path / "image").write_bytes(b"x")
    logs.upload("002/image", tmp_path / "image")
    monkeypatch.setattr(Bucket, "download", lambda *_: None)
    root = root_at_hand(Path(logs.address), "002")
    with pytest.raises(DataError, match="002/image: it is gone"), root:
        pytest.fail("a file that is not there was read")


@pytest.mark.usefixtures("asked")
def test_a_machine_without_a_mirror_yet_knows_its_room(address, tmp_path, monkeypatch):
    monkeypatch.setenv("LIDARPAINTER_CACHE", str(tmp_path / "elsewhere"))
    there = stub_ledger(address)
    assert not there.store.root.exists()
    assert lacks_disk(there, Budget(free_disk_gb=0)) is None
    write_metrics(there, "stub", tmp_path / "stub.prom")
    assert "store_free_bytes" in (tmp_path / "stub.prom").read_text()


class Ended:
    """A worker's process that is through, with some exit code."""

    def __init__(self, code):
        self.returncode = code

    def poll(self):
        return self.returncode


@pytest.mark.usefixtures("impatient")
def test_a_command_waits_with_its_workers_for_a_bucket_that_is_away(asked, stand_in):
    codes, heard = [1, 0], []

    def hears(line):
        heard.append(line)
        stand_in.fail()

    stand_in.fail(before=10**6)
    run_workers(asked, "stub", lambda _number: Ended(codes.pop(0)), 1, hears)
    assert codes == []  # the one that died was replaced
    assert heard[0].startswith("paused: cannot ")
    assert heard[1:] == ["2 waiting"]


@pytest.mark.usefixtures("impatient")
def test_a_bucket_that_is_away_holds_a_fleet_up(asked, address, tmp_path, stand_in):
    worker = stub_worker(address, "stub")
    heard = []

    def hears(line):
        heard.append(line)
        if "begins" in line and len(heard) == 1:
            stand_in.fail(before=10**6)
        elif line.startswith("paused"):
            stand_in.fail()

    worker.say = hears
    worker.run()
    rows = asked.rows("stub")
    assert [(row["state"], row["attempts"]) for row in rows] == [("done", 1)] * 2
    assert asked.leases.held() == []
    assert str(tmp_path) not in str(rows)
    (paused,) = [line for line in heard if line.startswith("paused")]
    assert address in paused
    assert "503" in paused


@pytest.mark.usefixtures("impatient", "asked")
def test_an_interrupted_worker_does_not_wait_for_a_bucket_that_is_away(address, stand_in):
    worker = stub_worker(address, "stub")
    heard = []

    def hears(line):
        heard.append(line)
        if line.startswith("paused"):
            stand_in.fail()

    def work(*_):
        stand_in.fail(before=10**6)
        raise Interrupted

    worker.say, worker.work = hears, work
    with pytest.raises(Interrupted):
        worker.run()
    stand_in.fail()
    assert [line for line in heard if line.startswith("paused")] == []
