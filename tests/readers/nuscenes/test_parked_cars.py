"""A car that is parked where two scenes of one location pass is one asset, elsewhere two."""

import json

import pytest
import torch
from nuscenes_log import write_nuscenes_log

from catalog.assets import enter_sightings
from catalog.store import open_store
from lidarpainter_models.errors import DataError
from lidarpainter_models.readers import ingest_scene
from lidarpainter_models.scenes.driving_scene import DrivingScene
from tasks.assets.enter import is_same, sighting
from tasks.opened import global_frame_of

SCENES = {"v1.0-trainval": "scene-0001", "v1.0-mini": "scene-0002"}


@pytest.fixture
def root(small_street, tmp_path):
    """The same street in two scenes, whose tracks have other ids."""
    for version, name in SCENES.items():
        write_nuscenes_log(small_street, tmp_path / "log", version=version, name=name)
    for table, key in (("instance", "token"), ("sample_annotation", "instance_token")):
        change(tmp_path / "log", table, key, lambda token: token[::-1])
    return tmp_path / "log"


def change(root, table, key, value):
    """In the second of them."""
    path = root / "v1.0-mini" / f"{table}.json"
    rows = [row | {key: value(row[key])} for row in json.loads(path.read_text())]
    path.write_text(json.dumps(rows))


def read(root, store):
    """Both scenes; the world of the second begins elsewhere."""
    return [
        DrivingScene.open(ingest_scene("nuscenes", root, name, store, frames=frames))
        for name, frames in zip(SCENES.values(), (None, slice(1, 4)), strict=True)
    ]


def num_sightings(root, store):
    """Of the assets that the standing actors of both scenes make."""
    for scene in read(root, store.root):
        run_id, scene_id = scene.sequence, f"nuscenes/{scene.sequence}"
        same = {"dataset": "nuscenes", "scene_id": scene_id, "run_id": run_id, "style": None}
        same["frame"] = global_frame_of(scene)
        standing = [track for track in scene.tracks if not track.is_moving]
        records = [record(track, scene.global_from_world) for track in standing]
        enter_sightings(store, [sighting(same, one) for one in records], is_same)
    return [row["num_sightings"] for row in store.rows("assets")]


def record(track, global_from_world):
    """Of a standing actor, as a published run holds it."""
    global_from_box = global_from_world @ track.world_from_box[0]
    known = {"kind": "actor", "name": track.actor_id, "actor_id": track.actor_id, "score": 0.5}
    known |= {"category": track.category, "is_moving": False}
    known |= dict(zip(("length_m", "width_m", "height_m"), track.size_m.tolist(), strict=True))
    known |= dict(zip(("x_m", "y_m", "z_m"), global_from_box[:3, 3].tolist(), strict=True))
    return known | {"heading_rad": float(torch.atan2(*global_from_box[[1, 0], 0]))}


@pytest.mark.slow
def test_a_parked_car_in_two_scenes_of_a_location_is_one_asset(root, tmp_path):
    found = num_sightings(root, open_store(tmp_path / "store"))
    assert found
    assert set(found) == {2}


def test_cars_at_the_same_place_of_another_map_are_others(root, tmp_path):
    change(root, "log", "location", lambda _name: "boston-seaport")
    assert set(num_sightings(root, open_store(tmp_path / "store"))) == {1}


def test_a_location_that_makes_no_name_is_refused(root, tmp_path):
    change(root, "log", "location", lambda _name: "../boston")
    with pytest.raises(DataError, match=r"log.json.*name 'nuscenes-../boston' cannot be used"):
        read(root, tmp_path / "store")
