"""Spoilt scenes are written once, and again when a fault has come to mean something else."""

from dataclasses import replace

from toy_store import TOY_SCENE, write_toy_scene

from catalog.store import open_store
from lidarpainter_models.stress.causes import CAUSES
from tasks.ingest.spoil import ingest_spoilt
from tasks.opened import open_scene

CAUSE, LEVEL = "camera-yaw", 1.0


def test_a_spoilt_scene_of_another_meaning_is_written_anew(tmp_path, monkeypatch):
    store = open_store(tmp_path)
    store.make()
    write_toy_scene(tmp_path)
    of_training = replace(CAUSES[CAUSE], is_of_log=False)
    with monkeypatch.context() as older:
        older.setitem(CAUSES, CAUSE, of_training)
        name = ingest_spoilt.fn(tmp_path, TOY_SCENE, CAUSE, LEVEL)
    before = open_scene(store, name).manifest
    assert before["stress"]["frames"] == "training"
    assert ingest_spoilt.fn(tmp_path, TOY_SCENE, CAUSE, LEVEL) == name
    after = open_scene(store, name).manifest
    assert after["stress"]["frames"] == "all"
    assert ingest_spoilt.fn(tmp_path, TOY_SCENE, CAUSE, LEVEL) == name
    assert open_scene(store, name).manifest == after
