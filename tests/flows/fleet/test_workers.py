"""Workers take, die, refuse and go on; the catalog holds each thing once."""

import gc
import shutil
import signal
import weakref
from types import SimpleNamespace

import pytest
from commands import call, complaint
from small_pandaset import PandasetFolder
from stub_fleet import (
    asked_ledger,
    behave,
    stub_starter,
    stub_work,
    stub_worker,
    write_stub_manifest,
)
from toy_store import write_toy_scene
from waiting import until

from catalog.errors import DamagedArtefactError, StorageError
from catalog.fleets import FleetLedger
from catalog.leases import FolderObjects, Leases
from catalog.retries import Ending
from catalog.store import open_store
from flows.fleet.asked_sequences import Asked, wishes
from flows.fleet.error_causes import cause_of
from flows.fleet.limits import admits
from flows.fleet.manifest import Budget, read_manifest
from flows.fleet.resource_forecast import Prediction
from flows.fleet.work import make_sequence
from flows.fleet.worker import MOST_HELD_BACK, Worker
from lidarpainter_models.errors import BackendError, SceneError, WriteError
from tasks.opened import open_scene

MADE = {"artefacts": {}, "computed_now": {}, "peak_memory_bytes": None}
STREETS = [f"synthetic/street-{seed:04d}" for seed in range(1, 5)]


@pytest.fixture
def store(tmp_path):
    found = open_store(tmp_path / "store")
    found.make()
    return found


@pytest.fixture
def asked(store, tmp_path):
    """A ledger in which a manifest of four streets was asked for."""
    return asked_ledger(store.root, write_stub_manifest(tmp_path))


def states(ledger):
    return [row["state"] for row in ledger.rows("stub")]


def causes(ledger, scene):
    rows = ledger.store.tables.rows("attempts")
    found = [row for row in rows if row["scene_id"] == scene]
    return [row["cause"] for row in sorted(found, key=lambda row: row["started_at"])]


def test_a_worker_decides_by_the_cause(asked, store):
    for scene, what in zip(STREETS, ("bad", "no memory", "full", "good"), strict=True):
        behave(store.root, scene, what)
    stub_worker(store.root, "stub").run()
    assert states(asked) == ["set-aside", "failed", "done", "done"]
    assert [causes(asked, scene) for scene in STREETS] == [
        ["bad-input"],
        ["memory"] * 3,
        ["disk-full", "done"],
        ["done"],
    ]
    first, second, *_ = asked.rows("stub")
    assert first["reason"] == f"{STREETS[0]}: the third image is damaged"
    assert second["reason"] == "MemoryError (3 attempts)"
    assert asked.leases.held() == []


def test_after_a_kill_another_worker_finishes(asked, store):
    behave(store.root, STREETS[0], "slow")
    victim = stub_starter(store.root, "stub", 1)(0)
    until(lambda: not list((store.root / "stub").iterdir()))  # it is in its work
    assert "running" in states(asked)
    victim.send_signal(signal.SIGKILL)
    victim.wait()
    stub_worker(store.root, "stub").run()
    assert states(asked) == ["done"] * 4
    assert causes(asked, STREETS[0]) == ["killed", "done"]
    assert asked.leases.held() == []


def test_a_cancelled_worker_leaves_its_work(asked, store):
    behave(store.root, STREETS[0], "slow")
    worker = stub_starter(store.root, "stub", 1)(0)
    until(lambda: not list((store.root / "stub").iterdir()))
    asked.cancel("stub")
    assert worker.wait(timeout=60) != 0
    assert states(asked) == ["failed"] * 4
    assert causes(asked, STREETS[0]) == ["cancelled"]


def test_a_corrupted_log_is_set_aside_with_its_reason(store, tmp_path, monkeypatch):
    log = PandasetFolder(tmp_path / "logs")
    log.write_log()
    (log.path / "camera" / "front_camera" / "00.jpg").write_bytes(b"no image")
    path = tmp_path / "night.toml"
    text = '[[source]]\ndataset = "pandaset"\nroot = "logs"\n[budget]\nfree_disk_gb = 0\n'
    path.write_text(f'name = "stub"\n{text}')
    ledger = asked_ledger(store.root, path)
    monkeypatch.delenv("PREFECT_API_URL", raising=False)
    worker = stub_worker(store.root, "stub")
    worker.work = make_sequence
    worker.run()
    row = ledger.rows("stub")[0]
    assert (row["state"], row["attempts"]) == ("set-aside", 1)
    assert "00.jpg" in row["reason"]


def test_no_work_begins_on_a_disk_without_room(asked, store, monkeypatch):
    usage = shutil.disk_usage(store.root)
    heard = []

    def fuller(_path):
        if len(heard) < 2:
            return usage._replace(free=-1)
        return usage

    monkeypatch.setattr("catalog.store.shutil.disk_usage", fuller)
    worker = stub_worker(store.root, "stub")
    monkeypatch.setattr("flows.fleet.worker.time.sleep", lambda _s: heard.append("slept"))
    lines = []
    worker.say = lines.append
    worker.run()
    assert states(asked) == ["done"] * 4
    paused = [line for line in lines if line.startswith("paused")]
    assert len(paused) == 1
    assert "expected 0.00 GB before a sequence begins" in paused[0]


def test_an_end_that_finds_no_room_is_entered_once_there_is_some(asked, store, monkeypatch):
    usage = shutil.disk_usage(store.root)
    worker = stub_worker(store.root, "stub")
    full, lines = [False], []

    def work(asked, store_path, attempt):
        full[0] = asked.scene_id == STREETS[1]
        return stub_work(asked, store_path, attempt)

    worker.work, worker.say = work, lines.append
    monkeypatch.setattr(
        "catalog.tables.shutil.disk_usage", lambda _: usage._replace(free=0) if full[0] else usage
    )
    monkeypatch.setattr("flows.fleet.worker.time.sleep", lambda _s: full.__setitem__(0, False))
    worker.run()
    assert states(asked) == ["done"] * 4
    assert [row["attempts"] for row in asked.rows("stub")] == [1] * 4
    assert any("paused" in line and "no space left" in line for line in lines)


def test_the_hours_of_a_budget_end_a_fleet(store, tmp_path):
    ledger = asked_ledger(store.root, write_stub_manifest(tmp_path, more="hours = 0.5\n"))
    lease = ledger.take(ledger.rows("stub")[0], {})
    ledger.end(lease, Ending(cause="done", run_id="run", seconds=1900.0))
    stub_worker(store.root, "stub").run()
    assert states(ledger) == ["done", *["waiting"] * 3]


def test_what_does_not_fit_into_memory_together_waits(tmp_path):
    leases = Leases(FolderObjects(tmp_path))
    budget = Budget(memory_gb=8)
    first, second, third = (
        leases.take(name, above=0, facts={"predicted_memory_bytes": gigabytes * 1e9})
        for name, gigabytes in (("a", 9), ("b", 3), ("c", 1))
    )
    assert admits(leases, first, budget)  # alone it would never begin otherwise
    assert not admits(leases, second, budget)
    leases.give_back(first)
    assert admits(leases, second, budget)
    assert admits(leases, third, budget)


def test_who_is_held_back_by_memory_takes_nothing_in_hand(store, tmp_path, monkeypatch):
    path = write_stub_manifest(tmp_path, sequences=2 * MOST_HELD_BACK, more="memory_gb = 8\n")
    ledger = FleetLedger(store)
    ledger.ask(wishes(read_manifest(path), path.parent))
    other = ledger.leases.take("other", above=0, facts={"predicted_memory_bytes": 6e9})
    predicted, taken, seen = [], [], []
    take = ledger.take

    def predict(asked):
        predicted.append(asked.scene_id)
        return Prediction(memory_bytes=3e9)

    def waits(_seconds):
        seen.append((len(predicted), len(taken)))
        ledger.leases.give_back(other)

    forecast = SimpleNamespace(effort=lambda _: None, predict=predict)
    monkeypatch.setattr(
        "flows.fleet.worker.ResourceForecast", SimpleNamespace(of=lambda _: forecast)
    )
    monkeypatch.setattr("flows.fleet.worker.time.sleep", waits)
    monkeypatch.setattr(ledger, "take", lambda *given: taken.append(given) or take(*given))
    Worker(ledger=ledger, fleet="stub", work=stub_work, say=print).run()
    assert seen == [(MOST_HELD_BACK, 0)]
    assert states(ledger) == ["done"] * 2 * MOST_HELD_BACK


@pytest.mark.parametrize(
    ("error", "cause"),
    [
        (SceneError("scene x lacks a camera"), "bad-input"),
        (BackendError("no cuda"), "error"),
        (DamagedArtefactError("no manifest"), "error"),
        (WriteError("cannot be written"), "system"),
        (StorageError(28, "No space left on device"), "disk-full"),
        (RuntimeError("Generic error: No space left on device (os error 28)"), "disk-full"),
        (RuntimeError("DefaultCPUAllocator: can't allocate memory: 8 bytes"), "memory"),
        (TimeoutError("late"), "timeout"),
        (ConnectionError("reset"), "system"),
        (ZeroDivisionError("division by zero"), "error"),
    ],
)
def test_an_error_has_one_cause(error, cause):
    assert cause_of(error)[0] == cause


@pytest.fixture
def stubbed(store, monkeypatch):
    """The command, with workers whose sequences cost nothing."""
    monkeypatch.setattr("flows.fleet.local_workers.starter", stub_starter)

    def run(*words):
        return call("--quiet", "fleet", *words, store=store)

    return run


@pytest.mark.slow
def test_the_command_runs_two_workers_and_says_how_it_stands(stubbed, store, tmp_path):
    behave(store.root, STREETS[1], "bad")
    path = write_stub_manifest(tmp_path)
    answer = stubbed("run", path, "--workers", "2", "--json")
    assert answer.code == 0, answer.err
    assert answer.json["counts"] == {
        "waiting": 0,
        "running": 0,
        "done": 3,
        "set-aside": 1,
        "failed": 0,
    }
    assert [one["scene"] for one in answer.json["sequences"]] == STREETS
    done, aside, *_ = answer.json["sequences"]
    assert (done["state"], done["reason"], done["attempts"]) == ("done", None, 1)
    assert done["run_id"] == "run-street-0001"
    assert done["seconds"] >= 0
    assert (aside["state"], aside["run_id"]) == ("set-aside", None)
    assert stubbed("status", "--json").json["counts"] == answer.json["counts"]
    amiss = stubbed("status", "stub", "--failed", "--json").json["sequences"]
    assert [one["scene"] for one in amiss] == [STREETS[1]]
    rows = [
        {"run_id": f"run-street-{n:04d}", "status": "complete", "artefacts": []} for n in (1, 3, 4)
    ]
    store.tables.merge("runs", rows)
    before = store.tables.rows("attempts")
    assert stubbed("run", path, "--json").json["sequences"] == answer.json["sequences"]
    assert store.tables.rows("attempts") == before


@pytest.mark.slow
def test_a_fleet_that_failed_exits_otherwise_and_can_be_retried(stubbed, store, tmp_path):
    behave(store.root, STREETS[0], "no memory")
    path = write_stub_manifest(tmp_path, sequences=1)
    assert stubbed("run", path, "--json").code == 2
    assert stubbed("retry", "--json").json == {"fleet": "stub", "scenes": [STREETS[0]]}
    behave(store.root, STREETS[0], "good")
    assert stubbed("run", path, "--json").code == 0


def test_a_fault_of_the_manifest_leaves_no_store(tmp_path, monkeypatch):
    monkeypatch.setenv("LIDARPAINTER_STORE", str(tmp_path / "store"))
    assert "no manifest" in complaint("fleet", "run", tmp_path / "absent.toml")
    assert not (tmp_path / "store").exists()


@pytest.mark.slow
def test_sequences_of_one_scene_are_told_apart(stubbed, tmp_path):
    path = write_stub_manifest(tmp_path, sequences=1)
    assert "seed of the fit" not in stubbed("run", path).out
    path.write_text("fit_seeds = [0, 7]\n" + path.read_text())
    said = stubbed("run", path).out
    assert "seed of" in said
    assert "the fit" in said
    assert "cameras" not in said


def asked_of_elsewhere(store, folder, fit_seeds="[0]"):
    path = folder / "night.toml"
    source = '[[source]]\ndataset = "canonical"\nroot = "logs"\n'
    head = f'name = "stub"\npainter = "none"\nfit_seeds = {fit_seeds}\n'
    path.write_text(f"{head}{source}[budget]\nfree_disk_gb = 0\n")
    return asked_ledger(store.root, path)


def test_a_scene_from_elsewhere_is_made_under_its_own_name(store, tmp_path, monkeypatch):
    shutil.copytree(write_toy_scene(tmp_path / "elsewhere"), tmp_path / "logs/drive-7")
    ledger = asked_of_elsewhere(store, tmp_path)

    def reconstructed(parameters, address):
        assert open_scene(open_store(address), parameters.scene).frame_indices
        return {"run_id": f"run of {parameters.scene}", **MADE}

    monkeypatch.setattr("flows.fleet.work.reconstruct", reconstructed)
    said = []
    Worker(ledger=ledger, fleet="stub", work=make_sequence, say=said.append, poll_s=0.2).run()
    (row,) = ledger.rows("stub")
    assert (row["scene_id"], row["state"]) == ("toy/street", "done"), said
    assert row["run_id"] == "run of toy/street"
    assert store.scene_ids() == ["toy/street"]


def test_a_street_that_another_draws_meanwhile_is_not_drawn_again(asked, store, monkeypatch):
    is_there, drawn, named = iter([False, True]), [], asked.rows("stub")[0]
    monkeypatch.delenv("PREFECT_API_URL", raising=False)
    monkeypatch.setattr("flows.fleet.work.has_street", lambda *_: next(is_there))
    monkeypatch.setattr("flows.fleet.work.ingest_street", lambda *given: drawn.append(given))
    monkeypatch.setattr("flows.fleet.work.reconstruct", lambda *_: {"run_id": "r", **MADE})
    made_now = make_sequence(Asked.model_validate_json(named["asked"]), store.address, "attempt")
    assert (made_now.run_id, drawn, list(is_there)) == ("r", [], [])


def test_a_worker_lets_go_of_what_a_sequence_had_opened(store, tmp_path, monkeypatch):
    shutil.copytree(write_toy_scene(tmp_path / "elsewhere"), tmp_path / "logs/drive-7")
    ledger, opened, kept = asked_of_elsewhere(store, tmp_path, "[0, 7]"), [], []

    def reconstructed(parameters, address):
        gc.collect()
        kept.extend(known for known in opened if known() is not None)
        opened.append(weakref.ref(open_scene(open_store(address), parameters.scene)))
        return {"run_id": str(len(opened)), **MADE}

    monkeypatch.setattr("flows.fleet.work.reconstruct", reconstructed)
    Worker(ledger=ledger, fleet="stub", work=make_sequence, say=print, poll_s=0.2).run()
    assert (len(opened), kept) == (2, [])


def test_a_scene_from_elsewhere_without_a_name_is_set_aside(store, tmp_path):
    folder = tmp_path / "logs/drive-7"
    folder.mkdir(parents=True)
    (folder / "manifest.json").write_text("{")
    ledger = asked_of_elsewhere(store, tmp_path)
    Worker(ledger=ledger, fleet="stub", work=make_sequence, say=print, poll_s=0.2).run()
    (row,) = ledger.rows("stub")
    assert (row["scene_id"], row["state"]) == ("canonical/drive-7", "set-aside")
    assert "drive-7/manifest.json: cannot be read" in row["reason"]
