"""A log that says neither where the car drove nor who is where: `localise`, `label`."""

import json
from unittest.mock import Mock

import pytest
from commands import call, refuse, succeed
from tiny_street import TINY, tiny_street

from catalog.store import open_store
from lidarpainter_models.lidar.localised import write_without_poses
from lidarpainter_models.scenes.driving_scene import DrivingScene
from lidarpainter_models.scenes.schema import LABELLED, LOCALISED, POSES
from lidarpainter_models.synthetic import RigLidar, SyntheticStreet
from lidarpainter_models.synthetic.sequence import record_street
from tasks.ingest.ingest import record_scene

STREET = "synthetic/street-0012"
STRIPPED = "synthetic/stripped"


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    store = open_store(tmp_path_factory.mktemp("unlabelled") / "store")
    store.make()
    config = tiny_street(12, num_frames=10, lidar=RigLidar(columns=900))
    path = record_street(SyntheticStreet(config), store.root)
    record_scene(store, path)
    record_scene(store, write_without_poses(DrivingScene.open(path), store.root, "stripped"))
    return store


def scene_of(store, scene_id):
    return DrivingScene.open(store.scene_folder(scene_id))


def test_what_has_no_poses_is_refused_with_the_command_that_finds_them(store):
    for words in (("reconstruct", STRIPPED, *TINY), ("label", STRIPPED)):
        line = refuse(*words, store=store)
        assert f"`lidarpainter localise {STRIPPED}` finds it" in line
    answer = call("doctor", STRIPPED, "--json", store=store)
    assert answer.code == 2
    (poses,) = [one for one in answer.json["findings"] if one["name"] == "ego poses"]
    assert f"lidarpainter localise {STRIPPED}" in poses["detail"]


def test_poses_are_found_and_then_who_moves(store):
    answer = call("localise", STRIPPED, "--json", store=store)
    assert answer.json["scene"] == f"{STRIPPED}-localised"
    assert answer.json["way_m"] > 3
    assert answer.code == (0 if answer.json["is_fit"] else 2)
    found = scene_of(store, f"{STRIPPED}-localised")
    truth = scene_of(store, STREET)
    assert found.manifest[POSES] == LOCALISED
    assert found.has_poses
    off_m = (found.world_from_ego - truth.world_from_ego)[-1, :3, 3].norm()
    assert float(off_m) < 0.05
    artefacts = len(store.tables.rows("artefacts"))
    shown = call("localise", STRIPPED, store=store)
    assert "way m" in shown.out
    assert len(store.tables.rows("artefacts")) == artefacts  # it was there

    written = succeed("label", f"{STRIPPED}-localised", "--json", store=store).json
    assert written["written"] == f"{STRIPPED}-localised-labelled"
    labelled = scene_of(store, written["written"])
    assert labelled.manifest[POSES] == LOCALISED
    assert {track.actor_id for track in labelled.tracks} == set(labelled.manifest[LABELLED])
    assert len(labelled.tracks) == len(written["actors"]) >= 2
    assert all(track.is_moving for track in labelled.tracks)
    assert "who moves" in succeed("label", written["written"], store=store).out


@pytest.mark.slow
def test_poses_and_boxes_that_are_there_are_judged_and_kept(store):
    told = succeed("localise", STREET, "--json", store=store).json
    assert told["translation_share"] < 0.01
    assert not store.scene_folder(f"{STREET}-localised").exists()
    rows = succeed("label", STREET, "--json", store=store).json
    assert rows["written"] is None
    assert any(row["found"] and row["given"] for row in rows["actors"])
    made = succeed("label", STREET, "--complete", "--as", "more", "--json", store=store).json
    assert made["written"] == "synthetic/more"
    before, after = scene_of(store, STREET), scene_of(store, "synthetic/more")
    kept = {track.actor_id for track in before.tracks}
    assert kept <= {track.actor_id for track in after.tracks}
    assert after.manifest["generator"] == before.manifest["generator"]


def test_boxes_that_a_person_changed_are_written_as_they_were_changed(store, tmp_path, monkeypatch):
    first, second, *others = (track.actor_id for track in scene_of(store, STREET).tracks)
    edits, visited = tmp_path / "edits.json", []
    changes = [
        {"op": "delete", "actors": [first]},
        {"op": "rename", "actor": second, "name": "bus-1", "category": "bus"},
    ]
    scene = scene_of(store, STREET)
    head = {"scene": STREET, "digest": scene.content_digest}
    edits.write_text(json.dumps({**head, "edits": changes}))
    monkeypatch.setattr("flows.cli.view.threading", Mock())  # else it shows until Ctrl-C
    monkeypatch.setattr("webbrowser.open", visited.append)
    shown = succeed("view", STREET, "--label", "--edits", edits, store=store)
    assert shown.out.splitlines() == visited
    told = succeed("label", STREET, "--edits", edits, "--json", store=store).json
    assert told == {"scene": STREET, "written": f"{STREET}-edited"}
    after = scene_of(store, told["written"])
    assert {track.actor_id for track in after.tracks} == {"bus-1", *others}
    assert {track.actor_id: track.category for track in after.tracks}["bus-1"] == "bus"
    assert after.manifest["provenance"]["label"]["edits"] == changes


def test_a_scene_of_another_origin_is_not_replaced(store):
    line = refuse("localise", STREET, "--as", "stripped", store=store)
    assert "was not made of synthetic/street-0012 by localise; it was kept" in line
    assert not scene_of(store, STRIPPED).has_poses
