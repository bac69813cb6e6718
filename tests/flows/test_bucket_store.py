"""A reconstruction whose store is a bucket, and what another machine then does with it."""

import json

import pytest
from bucket_stand_in import PRIVATE_WORD
from commands import call, succeed
from toy_store import TOY_SCENE, small_parameters, write_toy_scene

from catalog.schemas import TABLES
from catalog.store import STORE_ENVIRONMENT, open_store
from flows.recall import recalled
from flows.reconstruct import reconstruct
from tasks.ingest.ingest import record_scene
from tasks.opened import open_scene

pytestmark = pytest.mark.slow


@pytest.fixture
def store(address):
    found = open_store(address)
    found.make()
    with found.scene_lock(TOY_SCENE):
        path = write_toy_scene(found.root)
    record_scene(found, path)
    return found


def test_a_run_in_a_bucket_is_anybodys(store, tmp_path, monkeypatch, stand_in):
    parameters = small_parameters()
    made = reconstruct(parameters, store.address)
    assert made["artefacts"]["prepare"].startswith(f"{store.name}/artefacts/observations/")
    told = json.dumps([store.rows(table) for table in TABLES], default=str)
    bucket = store.mirror.bucket
    told += "".join(repr(bucket.read(name)[0]) for name in bucket.sizes("") if "json" in name)
    assert str(tmp_path) not in told
    assert PRIVATE_WORD not in told

    monkeypatch.setenv("LIDARPAINTER_CACHE", str(tmp_path / "elsewhere"))
    there = open_store(store.address)
    before = len(stand_in.requests())
    assert recalled(parameters, store.address)["run_id"] == made["run_id"]
    assert len(stand_in.requests()) - before < 60
    assert not (there.root / "artefacts").exists()  # recalled, not fetched

    monkeypatch.setenv(STORE_ENVIRONMENT, store.name)
    run_id = made["run_id"]
    words = ["--trajectory", "recorded", "--out", tmp_path / "views"]
    succeed("render", run_id, *words)
    assert list((tmp_path / "views").rglob("*.png"))
    assert call("edit", run_id, "actors", "--json").code == 0
    succeed("export", run_id, "--format", "ply", "--out", tmp_path / "scene.ply")
    explained = succeed("catalog", "explain", run_id, "--json").json
    assert not explained["stale"]
    succeed("catalog", "delete", run_id, "--yes")
    assert there.artefacts.ids() == set()
    assert not [name for name in bucket.sizes("") if name.startswith("artefacts/")]


def test_a_scene_is_fetched_as_it_is_read(store, tmp_path, monkeypatch):
    monkeypatch.setenv("LIDARPAINTER_CACHE", str(tmp_path / "elsewhere"))
    there = open_store(store.address)
    scene = open_scene(there, TOY_SCENE)
    scene.read_jpeg(scene.views[0])
    arrays = there.scene_folder(TOY_SCENE) / "scene.zarr"
    assert [path.name for path in arrays.iterdir()] == ["image_bytes"]
    assert call("--store", store.name, "catalog", "list", "scenes").code == 0
