"""Which sightings the tasks call one car: in overlapping clips, by track id, by boxes that meet."""

from types import SimpleNamespace

import pytest
from parked_world import clip

from catalog.artefacts import Recipe
from catalog.assets import enter_sightings
from catalog.code_closure import Code
from catalog.store import open_store
from lidarpainter_models.assets.extraction import write_assets
from tasks.assets import enter
from tasks.assets.enter import enter_published, ids_of, is_same
from tasks.assets.publish import SIGHTINGS_FILE
from tasks.exports.asset import export_asset, export_gallery
from tasks.json_files import write_json

UUID = "0d238564-0ebe-47b3-8067-593b980ce26d"


def rows_of(source, folder, scene):
    """The rows of a published clip, as a run of that scene would have them."""
    same = {"dataset": "toy", "scene_id": scene, "frame": "town", "run_id": scene, "style": None}
    same |= {"licence": "none", "artefact_id": f"assets/{scene}"}
    return [same | one | ids_of(same, one) for one in write_assets(source, folder)]


def test_a_parked_car_in_two_overlapping_clips_is_one_asset_with_two_sightings(tmp_path):
    """The second clip begins 2 m on, and its boxes were drawn 0.3 m beside the first one's."""
    store = open_store(tmp_path / "store")
    first = rows_of(clip(), tmp_path / "first", "toy/first")
    second = rows_of(clip(begins_m=2.0, drawn_m=0.3), tmp_path / "second", "toy/second")
    for rows in (first, second):
        enter_sightings(store, rows, is_same)
    cars = [row for row in store.tables.rows("assets") if row["kind"] == "actor"]
    assert [row["num_sightings"] for row in cars] == [2]
    assert cars[0]["scene_ids"] == ["toy/first", "toy/second"]
    places = [row["x_m"] for row in store.tables.rows("sightings") if row["kind"] == "actor"]
    assert abs(places[0] - places[1]) == pytest.approx(0.3, abs=0.1)
    others = [row for row in store.tables.rows("assets") if row["kind"] != "actor"]
    assert {row["num_sightings"] for row in others} == {1}


def test_what_was_published_into_a_bucket_is_at_hand_on_another_machine(
    address, tmp_path, monkeypatch
):
    def build(place):
        write_json(place.output / SIGHTINGS_FILE, write_assets(clip(), place.output))

    recipe = Recipe(kind="assets", inputs={}, config={}, code=Code(("a:build",), {"a": "x"}))
    ref, _ = open_store(address).artefacts.produce(recipe, build)
    monkeypatch.setenv("LIDARPAINTER_CACHE", str(tmp_path / "elsewhere"))
    store = open_store(address)
    scene = SimpleNamespace(manifest={"licence": "none"})
    monkeypatch.setattr(enter, "open_scene", lambda *_: scene)
    monkeypatch.setattr(enter, "global_frame_of", lambda _scene: "town")
    run = SimpleNamespace(run_id="run", scene_id="toy/street")
    enter_published(store, run, SimpleNamespace(ref=ref), None)
    assets = store.tables.rows("assets")
    gallery = export_gallery(store, assets, tmp_path / "gallery")
    assert gallery["num_pictures"] == sum(row["thumbnail"] is not None for row in assets) > 0
    (car,) = [row for row in assets if row["kind"] == "actor"]
    assert export_asset(store, car, "ply", tmp_path / "car.ply")["num_gaussians"] > 0


def box(**changes):
    """A parked car of the toy town."""
    row = {
        "kind": "actor",
        "dataset": "toy",
        "style": None,
        "category": "car",
        "frame": "town",
        "actor_id": "7",
        "is_moving": False,
        "occurrence_id": str(sorted(changes.items())),
        "x_m": 5e5,
        "y_m": 4e6,
        "z_m": 10.0,
        "heading_rad": 0.3,
        "length_m": 4.5,
        "width_m": 1.8,
        "height_m": 1.5,
    }
    return row | changes


@pytest.mark.parametrize(
    ("other", "expected"),
    [
        (box(actor_id="8"), True),
        (box(x_m=5e5 + 1.0), True),
        (box(heading_rad=0.3 + 3.1416), True),  # drawn the other way round
        (box(x_m=5e5 + 4.6), False),  # behind it in the row
        (box(y_m=4e6 + 2.4), False),  # beside it
        (box(z_m=13.0), False),  # on the next level
        (box(category="truck"), False),
        (box(style="night:1"), False),
        (box(frame="village"), False),
        (box(dataset="other"), False),
        (box(is_moving=True), False),
    ],
)
def test_boxes_that_meet_are_one_car(other, expected):
    assert is_same(box(), other) is expected
    assert is_same(other, box()) is expected


def test_a_track_id_that_is_given_once_is_one_car_wherever_it_drove():
    drives = box(actor_id=UUID, is_moving=True, frame="a")
    elsewhere = box(actor_id=UUID, is_moving=True, frame="b", x_m=0.0)
    assert is_same(drives, elsewhere)
    counted = (box(is_moving=True, frame="a"), box(is_moving=True, frame="b", x_m=0.0))
    assert not is_same(*counted)  # car 7 of one log is not car 7 of another
