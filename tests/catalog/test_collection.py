"""What somebody needs stays, what nobody needs is found, whoever was killed in the middle."""

import fcntl
import json
import os
import time
from datetime import UTC, datetime, timedelta

import pytest

from catalog.collection import plan_collection
from catalog.deletion import delete
from catalog.locks import held_lock
from catalog.needs import Needs
from catalog.store import open_store
from lidarpainter_models.weather.mix import StyleMix

NOW = datetime.now(UTC)
LONG_AGO = NOW - timedelta(days=90)
SINCE = NOW - timedelta(days=30)


@pytest.fixture(scope="module")
def old_shop(first_shop, tmp_path_factory):
    """All of it is old, and no painter is in it."""
    made = first_shop.copied(tmp_path_factory.mktemp("shop"))
    made.store.tables.delete("painters", "painter_id", ["p1"])
    artefacts, runs = (made.store.tables.rows(table) for table in ("artefacts", "runs"))
    made.store.tables.merge("artefacts", [{**row, "created_at": LONG_AGO} for row in artefacts])
    then = {"started_at": LONG_AGO, "finished_at": LONG_AGO}
    made.store.tables.merge("runs", [{**row, **then} for row in runs])
    return made


@pytest.fixture
def shop(old_shop, tmp_path):
    made = old_shop.copied(tmp_path)
    age(made.store.root / "scenes/toy/street", days=90)
    return made


def age(path, *, days):
    then = time.time() - days * 86400
    os.utime(path, (then, then))


def going(shop):
    return {
        (one.table, one.row_id.split("/")[0] if one.table == "artefacts" else one.row_id)
        for one in plan_collection(shop.store, SINCE)
    }


def ids(table, *names):
    return {(table, name) for name in names}


EVERYTHING = {
    *ids("runs", "r1", "r2"),
    *ids("artefacts", "fit", "first", "second", "flicker"),
    *ids("scenes", "toy/street"),
}
OF_R1 = {*ids("runs", "r1"), *ids("artefacts", "first", "flicker")}


def test_nothing_recent_needs_old_things(shop):
    assert going(shop) == EVERYTHING
    delete(shop.store, plan_collection(shop.store, SINCE))
    assert not list(shop.store.root.glob("artefacts/*/*"))
    assert not (shop.store.root / "scenes/toy/street").exists()
    assert going(shop) == set()


def test_a_recent_run_keeps_what_it_was_made_from(shop):
    shop.change("runs", "r2", finished_at=NOW)
    assert going(shop) == OF_R1


def test_an_artefact_without_a_row_stays_with_a_run_that_lists_it(shop):
    shop.change("runs", "r2", finished_at=NOW)
    shop.store.tables.delete("artefacts", "artefact_id", [shop.second.artefact_id])
    age(shop.store.artefacts.folder(shop.second), days=90)
    assert going(shop) == OF_R1


def test_a_wanted_sequence_keeps_its_run(shop):
    wanted = {"sequence_id": "s1", "scene_id": "toy/street", "run_id": "r2", "state": "done"}
    shop.store.tables.merge("sequences", [wanted])
    assert going(shop) == OF_R1


def test_a_sequence_that_waits_keeps_what_it_may_take_up(shop):
    waiting = {"sequence_id": "s1", "scene_id": "toy/street", "state": "waiting"}
    shop.store.tables.merge("sequences", [waiting])
    assert going(shop) == ids("runs", "r1", "r2")


def test_what_many_waiting_scenes_need_is_found_in_time(tmp_path):
    store, numbers = open_store(tmp_path), range(2000)
    scenes = [{"scene_id": f"toy/{n}", "content_digest": f"scene{n}"} for n in numbers]
    waiting = [{"sequence_id": f"{n}", "scene_id": f"toy/{n}", "state": "waiting"} for n in numbers]
    made = [
        {
            "artefact_id": f"{kind}/{kind}{n}",
            "inputs": f'{{"it": "{source}{n}"}}',
            "created_at": LONG_AGO,
        }
        for n in numbers
        for source, kind in (("scene", "fit"), ("fit", "first"), ("first", "second"))
    ]
    for table, rows in (("scenes", scenes), ("sequences", waiting), ("artefacts", made)):
        store.tables.merge(table, rows)
    needs = Needs(store)
    began = time.process_time()
    assert len(needs.kept_since(SINCE).artefacts) == len(made)
    assert time.process_time() - began < 0.7  # a look at all artefacts for each scene takes 2 s


def test_a_running_run_keeps_what_it_may_take_up(shop):
    shop.run("r3", status="running")
    with shop.store.run_lock("r3"):
        assert going(shop) == ids("runs", "r1", "r2")


def test_a_trained_painter_stays_with_what_it_was_made_from(shop):
    shop.store.tables.merge(
        "painters", [{"painter_id": "p", "path": f"artefacts/{shop.second.artefact_id}/w"}]
    )
    gone = {*ids("runs", "r1", "r2"), *ids("artefacts", "first", "flicker")}
    assert going(shop) == gone


def test_what_was_made_from_a_needed_artefact_stays_though_no_run_lists_it(shop):
    shop.change("runs", "r1", finished_at=NOW)
    assert going(shop) == {*ids("runs", "r2"), *ids("artefacts", "second")}


def test_a_changed_run_keeps_the_run_that_it_was_changed_from(shop):
    shop.change("runs", "r2", finished_at=NOW, derived_from="r1")
    assert going(shop) == set()


@pytest.mark.parametrize(
    ("variants", "prompt", "is_kept"),
    [(["night"], "night", True), (["foggy"], "night", False), (["night"], "night:0.5", False)],
)
def test_a_wanted_style_stays_whichever_run_it_was_made_of(shop, variants, prompt, is_kept):
    scene = shop.made("gaussians", fit=shop.fit.digest)
    dressed = shop.made("dressed", source=scene.digest)
    shop.run("main", scene)
    shop.run("styled", dressed)
    parameters = {"prompt": StyleMix.parse(prompt).text}
    change = json.dumps({"kind": "style", "parameters": parameters})
    shop.change("runs", "styled", change=change, derived_from="r1")
    for ref in (scene, dressed):
        shop.change("artefacts", ref.artefact_id, created_at=LONG_AGO)
    wanted = {"sequence_id": "s1", "scene_id": "toy/street", "run_id": "main", "state": "done"}
    shop.store.tables.merge("sequences", [{**wanted, "variants": variants}])
    assert (("runs", "styled") not in going(shop)) == is_kept
    assert (("runs", "r1") not in going(shop)) == is_kept
    assert ("runs", "main") not in going(shop)


def test_an_asset_keeps_the_best_run_of_each_scene_that_shows_it(shop):
    for run in ("r3", "r4"):
        shop.run(run)
    seen = {"asset_id": "a", "kind": "actor", "score": 0.5}
    rows = [("s1", "a", "r1", 0.4), ("s2", "b", "r2", 0.9), ("s3", "a", "r3", 0.3)]
    names = ("sighting_id", "occurrence_id", "run_id", "score")
    shop.store.tables.merge(
        "sightings", [seen | dict(zip(names, row, strict=True)) for row in rows]
    )
    shop.store.tables.merge("assets", [{**seen, "run_id": "r2"}])
    assert {name for table, name in going(shop) if table == "runs"} == {"r3", "r4"}


def test_what_killed_processes_left_is_found_and_what_is_locked_is_not(shop):
    root, digest = shop.store.root, "0" * 32
    wanted = {"sequence_id": "s1", "scene_id": "toy/street", "run_id": "r1", "state": "done"}
    shop.store.tables.merge("sequences", [wanted, {**wanted, "sequence_id": "s2", "run_id": "r2"}])
    abandoned = (
        f"artefacts/fit/{digest}",
        f"work/{digest}",
        f"aside/{digest}-12345678",
        "scenes/toy/.street.writing-1234",
    )
    for name in (*abandoned, f"work/{shop.fit.digest}", "aside/fresh-1"):
        (root / name).mkdir(parents=True)
    for name in abandoned:
        age(root / name, days=90)
    (root / "leases").mkdir()
    (root / "leases" / "s1").write_text("{}")
    found = {*ids("leftovers", *abandoned, f"work/{shop.fit.digest}")}
    assert going(shop) == found
    writing = root / "scenes/toy/.street.writing-1234/.writing"
    writing.touch()
    age(writing.parent, days=90)
    with held_lock(root / "locks" / f"{digest}.lock"), writing.open("rb") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        assert going(shop) == ids("leftovers", f"work/{shop.fit.digest}")
    delete(shop.store, plan_collection(shop.store, SINCE))
    assert going(shop) == set()
    assert (root / "leases" / "s1").exists()
