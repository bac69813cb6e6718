"""What a fleet was asked for, who works on it and how that ended: each exactly once."""

import subprocess
import sys
from pathlib import Path

import pytest
from fleet_wishes import wish

from catalog.errors import UnknownRecordError
from catalog.fleets import FleetLedger
from catalog.leases import FolderObjects, Leases
from catalog.retries import MAX_TRIES, Ending
from catalog.store import open_store

ROOT = Path(__file__).resolve().parents[2]
DONE = Ending(cause="done", run_id="run", seconds=2.0)
WORKER = """
import sys, time
from catalog.retries import Ending
from catalog.fleets import FleetLedger
from catalog.store import open_store
ledger = FleetLedger(open_store(sys.argv[1]))
while waiting := [row for row in ledger.rows("night") if row["state"] == "waiting"]:
    for row in waiting:
        if lease := ledger.take(row, {}):
            assert ledger.end(lease, Ending(cause="done", run_id="run"))
            break
    time.sleep(0.01)
"""


@pytest.fixture
def ledger(tmp_path, clock):
    leases = Leases(FolderObjects(tmp_path / "leases"), time_to_live_s=60.0, now=clock)
    return FleetLedger(open_store(tmp_path), leases=leases, first_pause_s=0.0)


def one(ledger, scene="x/one"):
    return next(row for row in ledger.rows("night") if row["scene_id"] == scene)


def attempted(ledger, ending, scene="x/one"):
    assert ledger.end(ledger.take(one(ledger, scene), {}), ending)
    return one(ledger, scene)


def causes(ledger):
    rows = ledger.store.tables.rows("attempts")
    return [row["cause"] for row in sorted(rows, key=lambda row: row["attempt_id"])]


def complete(ledger, run_id="run", **about):
    row = {"run_id": run_id, "status": "complete", "artefacts": [], **about}
    ledger.store.tables.merge("runs", [row])


def test_what_is_done_as_asked_stays_done(ledger):
    ledger.ask([wish(), wish("x/two", position=1)])
    complete(ledger)
    attempted(ledger, DONE)
    ledger.ask([wish(), wish("x/two", position=1)])
    assert [row["state"] for row in ledger.rows("night")] == ["done", "waiting"]
    assert len(ledger.store.tables.rows("sequences")) == 2


@pytest.mark.parametrize(
    ("change", "accept_stale", "state"),
    [
        ({"asked_digest": "otherwise"}, False, "waiting"),
        ({"code_digest": "changed"}, False, "waiting"),
        ({"code_digest": "changed"}, True, "done"),
        ({"priority": 3}, False, "done"),
    ],
)
def test_what_is_asked_otherwise_is_done_again(ledger, change, accept_stale, state):
    ledger.ask([wish()])
    complete(ledger)
    attempted(ledger, DONE)
    ledger.ask([wish(**change)], accept_stale=accept_stale)
    assert one(ledger)["state"] == state
    assert one(ledger)["priority"] == change.get("priority", 0)


def test_who_works_on_a_sequence_goes_on_where_it_is_only_moved(ledger):
    ledger.ask([wish()])
    lease = ledger.take(one(ledger), {})
    ledger.ask([wish(position=4, priority=3, budget='{"hours":1}')])
    assert ledger.end(lease, DONE)
    row = one(ledger)
    assert (row["state"], row["priority"], row["position"]) == ("done", 3, 4)
    assert row["budget"] == '{"hours":1}'


def test_who_is_gone_while_it_was_asked_otherwise_counts_as_killed(ledger, clock):
    ledger.ask([wish()])
    ledger.take(one(ledger), {})
    ledger.ask([wish(asked_digest="otherwise")])
    clock.now += 61
    assert ledger.reconcile() != []
    assert causes(ledger) == ["killed"]
    assert (one(ledger)["state"], one(ledger)["tries"]) == ("waiting", 0)


def test_hours_are_of_all_attempts_whatever_is_tried_again(ledger):
    ledger.ask([wish()])
    assert attempted(ledger, Ending(cause="error", seconds=5.0))["state"] == "failed"
    assert ledger.retry("night") == ["x/one"]
    assert one(ledger)["seconds"] == 5.0
    ledger.ask([wish(asked_digest="otherwise")])
    assert (one(ledger)["seconds"], one(ledger)["attempts"]) == (5.0, 1)
    assert attempted(ledger, DONE)["seconds"] == 7.0


def test_what_was_deleted_from_the_store_is_done_again(ledger):
    ledger.ask([wish()])
    attempted(ledger, DONE)  # its run is not in the catalog
    ledger.ask([wish()])
    assert one(ledger)["state"] == "waiting"


@pytest.mark.parametrize(("content", "state"), [("as it was", "done"), ("changed", "waiting")])
def test_what_was_made_of_a_scene_that_was_read_anew_is_done_again(ledger, content, state):
    ledger.ask([wish()])
    complete(ledger, scene_id="x/one", scene_digest="as it was")
    attempted(ledger, DONE)
    ledger.store.tables.merge("scenes", [{"scene_id": "x/one", "content_digest": content}])
    ledger.ask([wish()])
    assert one(ledger)["state"] == state


def test_what_is_no_longer_asked_for_is_forgotten_but_not_its_attempts(ledger):
    ledger.ask([wish(), wish("x/two")])
    attempted(ledger, DONE)
    ledger.ask([wish("x/two")])
    assert [row["scene_id"] for row in ledger.rows("night")] == ["x/two"]
    assert causes(ledger) == ["done"]


def test_what_comes_back_counts_on_and_its_late_worker_is_refused(ledger):
    both, other = [wish(), wish("x/two")], [wish("x/two")]
    ledger.ask(both)
    attempted(ledger, Ending(cause="interrupted"))
    late = ledger.take(one(ledger), {})
    ledger.ask(other)
    ledger.ask(both)
    assert not ledger.end(late, DONE)
    assert one(ledger)["state"] == "waiting"
    ledger.ask(other)
    ledger.ask(both)
    attempted(ledger, DONE)
    assert causes(ledger) == ["interrupted", "done", "done"]


def test_running_is_what_a_live_lease_says(ledger, clock):
    ledger.ask([wish()])
    assert ledger.take(one(ledger), {}) is not None
    assert one(ledger)["state"] == "running"
    assert ledger.store.tables.rows("sequences")[0]["state"] == "waiting"
    clock.now += 61
    assert one(ledger)["state"] == "waiting"


def test_a_late_worker_cannot_undo_what_came_after_it(ledger, clock):
    ledger.ask([wish()])
    late = ledger.take(one(ledger), {})
    clock.now += 61
    assert ledger.reconcile() != []
    attempted(ledger, DONE)
    assert not ledger.end(late, Ending(cause="error", reason="late"))
    assert one(ledger)["state"] == "done"
    assert causes(ledger) == ["killed", "done"]
    assert ledger.leases.held() == []


def test_a_row_that_was_read_long_ago_is_not_taken(ledger):
    ledger.ask([wish()])
    stale = one(ledger)
    attempted(ledger, DONE)
    assert ledger.take(stale, {}) is None
    assert ledger.leases.held() == []


def test_bad_input_is_set_aside_until_it_is_named(ledger):
    ledger.ask([wish()])
    row = attempted(ledger, Ending(cause="bad-input", reason="box 3 has no length"))
    assert (row["state"], row["reason"]) == ("set-aside", "box 3 has no length")
    ledger.ask([wish()])
    assert one(ledger)["state"] == "set-aside"
    assert ledger.retry("night") == []
    assert ledger.retry("night", ["x/one"]) == ["x/one"]
    assert one(ledger)["state"] == "waiting"


def test_what_can_pass_is_tried_later_and_not_for_ever(ledger):
    ledger.ask([wish()])
    for _ in range(MAX_TRIES - 1):
        row = attempted(ledger, Ending(cause="memory", reason="MemoryError"))
        assert row["state"] == "waiting"
        assert row["not_before"] is not None
    row = attempted(ledger, Ending(cause="memory", reason="MemoryError"))
    assert (row["state"], row["reason"]) == ("failed", f"MemoryError ({MAX_TRIES} attempts)")
    assert ledger.retry("night") == ["x/one"]
    assert one(ledger)["tries"] == 0


def test_a_full_disk_and_an_interruption_do_not_count(ledger):
    ledger.ask([wish()])
    for _ in range(MAX_TRIES + 1):
        row = attempted(ledger, Ending(cause="disk-full"))
        row = attempted(ledger, Ending(cause="interrupted"))
    assert (row["state"], row["tries"], row["attempts"]) == ("waiting", 0, 2 * MAX_TRIES + 2)


def test_after_a_full_disk_it_is_tried_later_each_time(ledger):
    slow = FleetLedger(ledger.store, leases=ledger.leases, first_pause_s=20.0)
    slow.ask([wish()])
    pauses = []
    for cause in ["disk-full"] * 9 + ["interrupted", "disk-full"]:
        row = attempted(slow, Ending(cause=cause))
        if cause == "disk-full":
            pauses.append((row["not_before"] - row["changed_at"]).total_seconds())
    assert pauses == [20.0, 40.0, 80.0, 160.0, 320.0, 640.0, 1280.0, 1800.0, 1800.0, 20.0]
    assert (row["state"], row["tries"]) == ("waiting", 0)


def test_a_worker_that_died_right_after_it_told_is_entered_as_it_told(ledger, clock, monkeypatch):
    ledger.ask([wish()])
    lease = ledger.take(one(ledger), {})
    with monkeypatch.context() as patched:
        patched.setattr(ledger.store.tables, "add_absent", lambda *_: 0)
        patched.setattr(ledger.leases, "give_back", lambda _: False)
        assert ledger.end(lease, DONE)
    clock.now += 61
    ledger.reconcile()
    assert one(ledger)["state"] == "done"
    assert causes(ledger) == ["done"]
    assert ledger.leases.held() == []


def test_cancelling_ends_leases_and_asking_again_goes_on(ledger):
    ledger.ask([wish(), wish("x/two", position=1)])
    lease = ledger.take(one(ledger), {})
    assert ledger.cancel("night") == ["x/one", "x/two"]
    assert [row["cause"] for row in ledger.rows("night")] == ["cancelled"] * 2
    assert ledger.leases.held() == []
    assert not ledger.end(lease, DONE)
    ledger.ask([wish(), wish("x/two", position=1)])
    assert [row["state"] for row in ledger.rows("night")] == ["waiting"] * 2


def test_the_latest_fleet_is_the_one_that_was_asked_for_last(ledger):
    ledger.ask([wish()])
    complete(ledger)
    before = attempted(ledger, DONE)
    ledger.ask([wish(fleet="day")])
    assert ledger.latest() == "day"
    ledger.ask([wish()])
    assert ledger.latest() == "night"
    after = one(ledger)
    assert before == {**after, "asked_at": before["asked_at"]}
    version = ledger.store.tables.delta("sequences").version()
    ledger.ask([wish()])
    assert ledger.store.tables.delta("sequences").version() == version


def test_one_scene_with_two_choices_of_cameras_is_two_sequences():
    choices = [None, ("front",), ("front", "left"), ("left", "front")]
    assert len({wish(cameras=cameras).sequence_id for cameras in choices}) == 3


def test_an_unknown_fleet_or_scene_is_one_line(ledger):
    with pytest.raises(UnknownRecordError, match="no fleet in"):
        ledger.latest()
    ledger.ask([wish()])
    with pytest.raises(UnknownRecordError, match=r"no fleet 'day' in .*, there is night"):
        ledger.rows("day")
    with pytest.raises(UnknownRecordError, match="fleet night has no scene x/three"):
        ledger.retry("night", ["x/three"])


@pytest.mark.slow
def test_eight_processes_share_a_fleet_and_nothing_is_lost_or_doubled(ledger, tmp_path):
    ledger.ask([wish(f"x/{number}", position=number) for number in range(40)])
    workers = [
        subprocess.Popen([sys.executable, "-c", WORKER, str(tmp_path)], cwd=ROOT) for _ in range(8)
    ]
    assert [worker.wait(timeout=300) for worker in workers] == [0] * 8
    rows = ledger.rows("night")
    assert [(row["state"], row["attempts"]) for row in rows] == [("done", 1)] * 40
    assert causes(ledger) == ["done"] * 40
    assert ledger.leases.held() == []
