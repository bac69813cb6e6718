"""What holds of a store in a folder holds of one in a bucket."""

import subprocess
import sys
from pathlib import Path

import pytest

from catalog.artefacts import ArtefactRef, Recipe
from catalog.code_closure import Code
from catalog.deletion import delete, plan_deletion
from catalog.errors import CatalogError, UnknownRecordError
from catalog.leases import LeaseLostError, Leases
from catalog.records import artefact_row
from catalog.store import existing_store, open_store

ROOT = Path(__file__).resolve().parents[2]
WRITER = """
import sys
from catalog.store import open_store
store, writer, count = open_store(sys.argv[1]), sys.argv[2], int(sys.argv[3])
for number in range(count):
    store.tables.merge("metrics", [
        {"metric_id": f"{writer}-{number}", "name": "psnr", "value": float(number)},
        {"metric_id": "shared", "name": "psnr", "value": 1.0},
    ])
"""
COUNTER = """
import sys, time
from pathlib import Path
from catalog.leases import Leases
from catalog.store import open_store
store, count = open_store(sys.argv[1]), Path(sys.argv[2])
leases = Leases(store.objects("leases"))
for _ in range(6):
    while (lease := leases.take("a", above=0, facts={})) is None:
        time.sleep(0.02)
    before = int(count.read_text()) if count.exists() else 0
    lease = leases.renew(lease, {})
    count.write_text(str(before + 1))
    assert leases.give_back(lease)
"""


@pytest.fixture
def store(any_address):
    found = open_store(any_address)
    found.make()
    return found


def recipe(steps=1):
    code = Code(("a:build",), {"a": "x"})
    return Recipe(kind="fit", inputs={"scene": "s"}, config={"steps": steps}, code=code)


def write_one(place):
    (place.output / "data.bin").write_bytes(b"12345")
    (place.output / "deep").mkdir()
    (place.output / "deep" / "more.bin").write_bytes(b"678")
    return {"num_gaussians": 3}


def run_all(script, *arguments_of_each):
    words = [sys.executable, "-W", "error", "-c", script]
    running = [subprocess.Popen([*words, *map(str, each)], cwd=ROOT) for each in arguments_of_each]
    assert [process.wait() for process in running] == [0] * len(running)


def test_an_artefact_is_made_once_and_read_as_it_was_written(store):
    ref, is_new = store.artefacts.produce(recipe(), write_one)
    assert is_new
    assert store.artefacts.produce(recipe(), pytest.fail) == (ref, False)
    again = open_store(store.address).artefacts
    assert again.find(recipe()) == ref
    assert again.find(recipe(steps=2)) is None
    assert again.verified(ref).summary == {"num_gaussians": 3}
    assert (again.files(ref) / "deep" / "more.bin").read_bytes() == b"678"
    assert again.ids() == {ref.artefact_id}


def test_a_stage_that_fails_leaves_nothing(store):
    def fails(place):
        write_one(place)
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        store.artefacts.produce(recipe(), fails)
    assert store.artefacts.find(recipe()) is None
    assert store.artefacts.ids() == set()
    with pytest.raises(UnknownRecordError):
        store.artefacts.manifest(ArtefactRef("fit", "none"))


def test_what_is_deleted_is_gone_from_the_store_and_its_tables(store):
    ref, _ = store.artefacts.produce(recipe(), write_one)
    row = artefact_row(ref, store.artefacts.manifest(ref))
    store.tables.merge("artefacts", [row])
    plan = plan_deletion(store, "artefacts", row)
    assert plan.own[0].num_bytes > 8
    delete(store, plan.own)
    assert store.artefacts.find(recipe()) is None
    assert store.rows("artefacts") == []
    assert store.artefacts.produce(recipe(), write_one) == (ref, True)


def test_leases_pass_from_hand_to_hand(store):
    leases = Leases(store.objects("leases"))
    lease = leases.take("a", above=3, facts={"scene_id": "x/y"})
    assert leases.take("a", above=9, facts={}) is None
    renewed = leases.renew(lease, {"memory_bytes": 7})
    with pytest.raises(LeaseLostError):
        leases.renew(lease, {})
    assert not leases.give_back(lease)
    assert [one.facts for one in leases.held()] == [{"scene_id": "x/y", "memory_bytes": 7}]
    assert leases.give_back(renewed)
    assert leases.held() == []
    assert leases.take("a", above=4, facts={}).fence == 5
    with pytest.raises(CatalogError, match="cannot name"):
        leases.take("../a", above=0, facts={})


def test_one_process_at_a_time_holds_a_lease(store, tmp_path):
    count = tmp_path / "count"
    run_all(COUNTER, *[(store.name, count)] * 2)
    assert count.read_text() == "12"


def test_a_run_is_running_while_somebody_works_on_it(store):
    ended = {"run_id": "r0", "status": "complete"}
    store.tables.merge("runs", [{"run_id": "r1", "status": "running"}, ended])
    assert store.run("r1")["status"] == "interrupted"
    with store.run_lock("r1"), store.run_lock("r1"):
        assert store.row("runs", "r1")["status"] == "running"
        assert sorted(row["status"] for row in store.rows("runs")) == ["complete", "running"]
    assert sorted(row["status"] for row in store.rows("runs")) == ["complete", "interrupted"]
    assert store.row("runs", "r1")["status"] == "interrupted"


def test_a_store_in_which_nothing_is_stored_is_none(store, monkeypatch):
    monkeypatch.setenv("LIDARPAINTER_STORE", store.name)
    with pytest.raises(CatalogError, match=f"no store at {store.name}"):
        existing_store()
    store.tables.merge("scenes", [{"scene_id": "toy/street"}])
    assert existing_store().rows("scenes")[0]["scene_id"] == "toy/street"


@pytest.mark.parametrize(
    ("writers", "commits"), [(2, 5), pytest.param(8, 25, marks=pytest.mark.slow)]
)
def test_no_commit_is_lost_or_doubled(store, writers, commits):
    run_all(WRITER, *[(store.name, writer, commits) for writer in range(writers)])
    ids = [row["metric_id"] for row in store.rows("metrics")]
    expected = {f"{writer}-{number}" for writer in range(writers) for number in range(commits)}
    assert sorted(ids) == sorted(expected | {"shared"})
