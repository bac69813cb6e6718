"""Which sightings are one asset, whoever comes first; what serves; what a style is derived from."""

from datetime import UTC, datetime

import pytest

from catalog.assets import (
    digest_of,
    enter_fused,
    enter_sightings,
    find_asset,
    forget_sightings,
    to_fuse,
)
from catalog.errors import UnknownRecordError
from catalog.store import open_store


def sighting(name, *, place=0.0, score=0.5, run="run", scene="toy/street", style=None, **more):
    """A parked car at a place of the toy town."""
    return {
        "sighting_id": digest_of(run, name),
        "occurrence_id": digest_of(scene, name, style),
        "base_id": digest_of(scene, name, None) if style else None,
        "kind": "actor",
        "dataset": "toy",
        "scene_id": scene,
        "run_id": run,
        "actor_id": name,
        "style": style,
        "is_moving": False,
        "frame": "town",
        "x_m": place,
        "y_m": 0.0,
        "score": score,
        "artefact_id": f"assets/{run}",
        "created_at": datetime(2026, 1, 1, tzinfo=UTC),
        **more,
    }


def is_same(one, other):
    near = abs(one["x_m"] - other["x_m"]) < 1.0 and one["style"] == other["style"]
    return near or one["occurrence_id"] == other["occurrence_id"]


def entered(store, *batches):
    for rows in batches:
        enter_sightings(store, rows, is_same)
    return tables(store)


def tables(store):
    return {name: store.tables.rows(name) for name in ("assets", "sightings")}


@pytest.fixture
def store(tmp_path):
    return open_store(tmp_path / "store")


def test_one_car_in_two_runs_is_one_asset_and_the_better_sighting_serves(store):
    near = sighting("a", place=0.2, score=0.9, run="near", scene="toy/second")
    found = entered(store, [sighting("a"), sighting("b", place=50.0)], [near])
    assets = {row["num_sightings"]: row for row in found["assets"]}
    assert len(found["assets"]) == 2
    assert assets[2]["run_id"] == "near"
    assert assets[2]["score"] == 0.9
    assert assets[2]["scene_ids"] == ["toy/second", "toy/street"]
    assert assets[1]["actor_id"] == "b"


def test_what_was_published_before_vehicles_were_whole_serves_last(store):
    old = sighting("a", score=0.9)
    new = sighting("a", run="new", score=0.4, seen_share=0.5)
    (asset,) = entered(store, [new], [old])["assets"]
    assert (asset["run_id"], asset["score"]) == ("new", 0.4)


def test_only_what_may_be_the_same_is_compared(store):
    unique = "e0b1a2c4-9f6d-4f7e"
    elsewhere = [
        sighting("a", run="far", place=500.0, scene="toy/1"),
        sighting("b", run="other", scene="toy/2", frame="village"),
        sighting(unique, run="third", scene="toy/3", frame="village"),
    ]
    entered(store, elsewhere)
    asked = []

    def noted(one, other):
        asked.append((one["run_id"], other["run_id"]))
        return False

    enter_sightings(store, [sighting(name, scene="toy/4") for name in ("a", "b", unique)], noted)
    assert {other for _one, other in asked} == {"run", "third"}  # others count their tracks


def test_the_same_again_changes_nothing(store):
    rows = [sighting("a"), sighting("b", place=50.0)]
    before = entered(store, rows)
    versions = [path.name for path in sorted(store.root.glob("tables/*/_delta_log/*.json"))]
    assert entered(store, rows) == before
    assert [path.name for path in sorted(store.root.glob("tables/*/_delta_log/*.json"))] == versions


def test_whoever_comes_first_the_assets_are_the_same(tmp_path):
    """The second sighting stands between the others, which alone are two cars."""
    batches = [
        [sighting("a", run="one", scene="toy/1")],
        [sighting("b", place=0.8, run="two", scene="toy/2")],
        [sighting("c", place=1.6, run="three", scene="toy/3")],
    ]
    orders = ((0, 1, 2), (2, 0, 1), (2, 1, 0))  # the one between comes second, last, second
    found = [
        entered(open_store(tmp_path / str(order)), *(batches[place] for place in order))
        for order in orders
    ]
    assert all(one == found[0] for one in found)
    (asset,) = found[0]["assets"]
    assert asset["num_sightings"] == 3
    assert asset["asset_id"] == min(row["occurrence_id"] for row in found[0]["sightings"])


def test_an_id_that_was_merged_away_still_names_its_asset(store):
    first = sighting("a", run="one", scene="toy/1")
    second = sighting("b", place=0.5, run="two", scene="toy/2")
    found = entered(store, [first], [second])
    (asset,) = found["assets"]
    for row in (first, second):
        assert find_asset(store, row["occurrence_id"][:8])["asset_id"] == asset["asset_id"]
    for name in ("zebra", ""):
        with pytest.raises(UnknownRecordError, match=f"no asset {name!r}"):
            find_asset(store, name)


def test_a_run_made_anew_keeps_the_ids(store):
    before = entered(store, [sighting("a", run="old")])
    after = entered(store, [sighting("a", run="new", place=30.0)])  # refined: elsewhere by now
    assert [row["asset_id"] for row in after["assets"]] == [
        row["asset_id"] for row in before["assets"]
    ]
    assert after["assets"][0]["num_sightings"] == 2


def test_a_style_is_derived_from_what_its_base_is_called_now(store):
    night = sighting("a", run="dressed", style="night:1")
    plain = sighting("a", run="plain")
    alone = entered(store, [night])
    assert alone["assets"][0]["derived_from"] is None  # its base is not published
    entered(store, [plain])
    other = sighting("z", run="again", scene="toy/other", place=0.3)
    found = entered(store, [other])
    by_style = {row["style"]: row for row in found["assets"]}
    assert len(found["assets"]) == 2
    assert by_style["night:1"]["derived_from"] == by_style[None]["asset_id"]
    assert by_style[None]["asset_id"] == min(plain["occurrence_id"], other["occurrence_id"])


def test_with_a_run_go_its_sightings_and_assets_that_nobody_else_saw(store):
    entered(
        store,
        [sighting("a", run="one", score=0.9), sighting("b", run="one", place=50.0)],
        [sighting("a", run="two", score=0.1, place=0.1)],
    )
    forget_sightings(store, "run_id", ["one"])
    found = tables(store)
    assert [row["run_id"] for row in found["sightings"]] == ["two"]
    (asset,) = found["assets"]
    assert (asset["run_id"], asset["num_sightings"], asset["score"]) == ("two", 1, 0.1)
    forget_sightings(store, "artefact_id", ["assets/two"])
    assert tables(store) == {"assets": [], "sightings": []}
    forget_sightings(store, "run_id", ["one"])


def seen_twice(store):
    """One whole car in two scenes; what is to be fused of it."""
    rows = [
        sighting("a", run="one", scene="toy/1", score=0.5, seen_share=0.3),
        sighting("b", run="two", scene="toy/2", score=0.6, seen_share=0.2, place=0.1),
    ]
    entered(store, rows)
    return to_fuse(store, {row["occurrence_id"] for row in rows})


def fused(members, score=0.7, artefact="fused/ab"):
    names = [row["sighting_id"] for row in members]
    return members[0] | {"score": score, "artefact_id": artefact, "fused_from": names}


def entered_fused(store, groups, **what):
    return enter_fused(store, {name: (rows, fused(rows, **what)) for name, rows in groups.items()})


@pytest.mark.parametrize(("score", "serves"), [(0.7, "fused/ab"), (0.55, "assets/two")])
def test_what_was_fused_serves_if_it_is_better_than_every_sighting(store, score, serves):
    groups = seen_twice(store)
    assert entered_fused(store, groups, score=score) == list(groups)
    (asset,) = tables(store)["assets"]
    assert (asset["artefact_id"], asset["num_sightings"]) == (serves, 2)
    assert asset["scene_ids"] == ["toy/1", "toy/2"]
    assert (asset["fused_from"] is None) == (serves == "assets/two")


def test_fused_again_nothing_changes(store):
    groups = seen_twice(store)
    entered_fused(store, groups)
    before = tables(store)
    versions = sorted(store.root.glob("tables/*/_delta_log/*.json"))
    assert seen_twice(store) == groups
    entered_fused(store, groups)
    assert tables(store) == before
    assert sorted(store.root.glob("tables/*/_delta_log/*.json")) == versions


def test_with_a_sighting_goes_what_was_fused_from_it(store):
    entered_fused(store, seen_twice(store))
    forget_sightings(store, "run_id", ["one"])
    found = tables(store)
    assert [row["artefact_id"] for row in found["sightings"]] == ["assets/two"]
    assert [row["artefact_id"] for row in found["assets"]] == ["assets/two"]
    assert to_fuse(store, {found["assets"][0]["asset_id"]}) == {}


def test_a_fused_one_of_other_sightings_is_replaced_and_never_entered_late(store):
    early = seen_twice(store)
    entered_fused(store, early)
    third = sighting("c", run="three", scene="toy/3", score=0.4, seen_share=0.1, place=0.2)
    entered(store, [third])
    (name,) = {row["asset_id"] for row in tables(store)["sightings"]}
    groups = to_fuse(store, {name})
    assert [row["run_id"] for row in groups[name]] == ["two", "one", "three"]
    entered_fused(store, groups, artefact="fused/abc")
    assert entered_fused(store, early) == []  # somebody who was slower
    (one,) = [row for row in tables(store)["sightings"] if row["fused_from"]]
    assert (one["artefact_id"], len(one["fused_from"])) == ("fused/abc", 3)
    enter_fused(store, {name: (groups[name], None)})  # they turn out to be of two things
    assert not [row for row in tables(store)["sightings"] if row["fused_from"]]


def test_of_two_runs_of_one_log_the_better_is_fused(store):
    seen_twice(store)
    again = sighting("a", run="again", scene="toy/1", score=0.8, seen_share=0.3)
    entered(store, [again])
    (rows,) = to_fuse(store, {row["asset_id"] for row in tables(store)["assets"]}).values()
    assert [row["run_id"] for row in rows] == ["again", "two"]
