"""What is deleted is gone with what it alone needed; what others need stays."""

import pytest

from catalog.deletion import delete
from catalog.errors import CatalogError, UnknownRecordError


def ids(doomed):
    return {(one.table, one.row_id.split("/")[0]) for one in doomed}


def test_a_run_goes_with_what_it_alone_needs(shop):
    plan = shop.plan("runs", "r1")
    assert ids(plan.own) == {("runs", "r1"), ("artefacts", "first"), ("artefacts", "flicker")}
    assert plan.dependents == ()
    assert sum(one.num_bytes for one in plan.own) > 2000
    delete(shop.store, plan.own)
    assert shop.names("runs") == {"r2"}
    assert shop.names("metrics") == {"m-r2"}
    assert shop.names("artefacts") == {"fit", "second"}
    assert not shop.store.artefacts.is_complete(shop.first)
    assert shop.store.artefacts.is_complete(shop.second)
    assert not list((shop.store.root / "aside").iterdir())


def test_an_artefact_is_needed_by_runs_by_painters_and_by_what_was_made_from_it(shop):
    plan = shop.plan("artefacts", shop.fit.artefact_id)
    assert ids(plan.own) == {("artefacts", "fit")}
    made = {("artefacts", name) for name in ("first", "second", "flicker")}
    assert ids(plan.dependents) == {("runs", "r1"), ("runs", "r2"), ("painters", "p1"), *made}
    assert shop.plan("artefacts", shop.flicker.artefact_id).dependents == ()


def test_a_scene_is_needed_by_all_that_was_made_of_it(shop):
    plan = shop.plan("scenes", "toy/street")
    assert len(plan.dependents) == 7
    delete(shop.store, (*plan.own, *plan.dependents))
    for table in ("scenes", "runs", "metrics", "artefacts", "painters"):
        assert shop.names(table) == set()
    assert not (shop.store.root / "scenes/toy/street").exists()
    assert not list(shop.store.root.glob("artefacts/*/*"))


def test_what_is_gone_already_is_deleted_all_the_same(shop):
    plan = shop.plan("runs", "r1")
    delete(shop.store, plan.own)
    delete(shop.store, plan.own)
    assert shop.names("runs") == {"r2"}


def test_a_run_that_is_running_stays(shop):
    shop.run("r3", shop.fit, status="running")
    with shop.store.run_lock("r3"), pytest.raises(CatalogError, match="r3 is running"):
        shop.plan("runs", "r3")


@pytest.mark.parametrize("name", ["../../etc", "fit/..", "fit", "a/b/c", "fit/.x"])
def test_names_of_a_strange_table_do_not_leave_the_store(shop, name):
    shop.store.tables.merge("artefacts", [{"artefact_id": name, "inputs": "{}"}])
    with pytest.raises(CatalogError, match="is no place in the store, nothing was deleted"):
        shop.plan("artefacts", name)


def test_a_link_out_of_the_store_is_not_followed(shop, tmp_path):
    (tmp_path / "outside").mkdir()
    (shop.store.root / "artefacts/fit/linked").symlink_to(tmp_path / "outside")
    shop.store.tables.merge("artefacts", [{"artefact_id": "fit/linked", "inputs": "{}"}])
    with pytest.raises(CatalogError, match="leads out of the store"):
        shop.plan("artefacts", "fit/linked")


def test_a_painter_is_not_deleted_by_itself(shop):
    with pytest.raises(UnknownRecordError, match="expected a run, an artefact or a scene"):
        shop.plan("painters", "p1")
