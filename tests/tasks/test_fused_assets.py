"""A car that two runs show, from its published files to what is fused, and to its end."""

import pytest
from sighted_cars import front, rear, sighting

from catalog.artefacts import Recipe
from catalog.assets import digest_of, enter_sightings
from catalog.code_closure import Code
from catalog.deletion import delete, plan_deletion
from catalog.store import open_store
from lidarpainter_models.assets.sighted_vehicles import SIGHTED_FILE, write_sighted
from lidarpainter_models.assets.written_actors import write_actor
from tasks.assets.enter import is_same
from tasks.assets.fuse import fuse_sightings

FOLDER, CAR = "actors/000", "0d238564-0ebe-47b3-8067-593b980ce26d"


def publish(store, run, seen, whole, *, keeps=True):
    """Enter what a run shows of the car; returns the id of the asset."""

    def build(place):
        record = write_actor(whole, seen.sighting, place.output, FOLDER, judged_on="training")
        if keeps:
            write_sighted(place.output / FOLDER / SIGHTED_FILE, seen)
        return {"record": record, "cpu_seconds": 0.0, "peak_memory_bytes": 0}

    recipe = Recipe(kind="assets", inputs={}, config={"run": run}, code=Code(("a:b",), {"a": "x"}))
    ref, _ = store.artefacts.produce(recipe, build)
    row = store.artefacts.manifest(ref).summary["record"] | {
        "sighting_id": digest_of(run),
        "occurrence_id": digest_of("scene", run),
        "category": "car",
        "dataset": "toy",
        "actor_id": CAR,
        "is_moving": True,
        "scene_id": f"toy/{run}",
        "run_id": run,
        "licence": "none",
        "frame": run,
        "artefact_id": ref.artefact_id,
        "x_m": 0.0,
        "y_m": 0.0,
    }
    (asset_id,) = enter_sightings(store, [row], is_same)
    return asset_id


@pytest.fixture(scope="module")
def sightings():
    return sighting(front), sighting(rear, azimuth_deg=180.0, gain=(0.6, 0.6, 0.6))


@pytest.fixture
def store(tmp_path):
    return open_store(tmp_path / "store")


def fused_rows(store):
    return [row for row in store.tables.rows("sightings") if row["fused_from"]]


def test_a_car_of_two_runs_is_fused_once_and_goes_with_what_it_was_made_from(store, sightings):
    assert fuse_sightings(store, {publish(store, "one", *sightings[0])}) == []
    asset_id = publish(store, "two", *sightings[1])
    assert fuse_sightings(store, {asset_id}) == [asset_id]
    (row,) = fused_rows(store)
    assert set(row["fused_from"]) == {digest_of("one"), digest_of("two")}
    (asset,) = store.tables.rows("assets")
    assert (asset["artefact_id"], asset["num_sightings"]) == (row["artefact_id"], 2)
    assert set(asset["sides"]) >= set(row["sides"])
    before = {name: store.tables.rows(name) for name in ("assets", "sightings", "artefacts")}
    fuse_sightings(store, {publish(store, "two", *sightings[1])})
    assert {name: store.tables.rows(name) for name in before} == before
    (fused,) = [
        one for one in store.tables.rows("artefacts") if one["artefact_id"] == row["artefact_id"]
    ]
    delete(store, plan_deletion(store, "artefacts", fused).own)
    assert fused_rows(store) == []
    assert store.tables.rows("assets")[0]["artefact_id"].startswith("assets/")


def test_what_was_published_without_what_fusing_needs_stays_as_it_is(store, sightings):
    publish(store, "one", *sightings[0], keeps=False)
    asset_id = publish(store, "two", *sightings[1])
    assert fuse_sightings(store, {asset_id}) == []
    assert fused_rows(store) == []
