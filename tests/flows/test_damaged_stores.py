"""A store that is not as it was written is answered in one line, never with a foreign error."""

import json

import pytest
from commands import call, complaint
from toy_store import TOY_SCENE, write_toy_scene

from catalog.store import open_store
from tasks.ingest.ingest import record_scene
from tasks.runs import open_run

RUN = {
    "run_id": "r1",
    "scene_id": TOY_SCENE,
    "status": "complete",
    "parameters": "{}",
    "result": "{}",
    "artefacts": ["observations/a", "gaussians/b"],
}
EVERY = [
    ("catalog", "show", "r1", "--json"),
    ("catalog", "explain", "r1"),
    ("evaluate", "r1"),
    ("render", "r1", "--trajectory", "recorded", "--out", "x"),
]


@pytest.fixture
def store(tmp_path):
    made = open_store(tmp_path / "store")
    record_scene(made, write_toy_scene(made.root))
    made.tables.merge("runs", [RUN])
    return made


def refused(store, words, expected):
    assert expected in complaint(*words, store=store)


def overwrite(paths, content):
    paths = list(paths)
    assert paths
    for path in paths:
        path.write_bytes(content(path))


@pytest.mark.parametrize("words", [*EVERY, ("catalog", "list"), ("reconstruct", TOY_SCENE)])
@pytest.mark.parametrize(
    ("files", "content"),
    [
        ("_delta_log/*.json", lambda _path: b"{garbage"),
        ("_delta_log/*.json", lambda _path: b""),
        ("*.parquet", lambda path: b"x" * path.stat().st_size),
    ],
    ids=["log garbage", "log empty", "rows garbage"],
)
def test_a_damaged_table(store, words, files, content):
    overwrite((store.root / "tables/runs").glob(files), content)
    refused(store, words, f"cannot read table {store.root}/tables/runs: it is damaged")


def test_a_table_whose_rows_are_gone(store):
    for path in (store.root / "tables/runs").glob("*.parquet"):
        path.unlink()
    refused(store, ("catalog", "list"), f"cannot read table {store.root}/tables/runs: it is dam")


@pytest.mark.parametrize(
    ("changes", "words", "expected"),
    [
        ({"parameters": "{x"}, EVERY[0], "parameters of r1 is no JSON"),
        ({"parameters": "{x"}, EVERY[3], "parameters of r1 is no JSON"),
        ({"artefacts": ["x"]}, EVERY[1], "'x' is no artefact, expected kind/digest"),
        ({"artefacts": ["x"]}, EVERY[2], "'x' is no artefact, expected kind/digest"),
        ({"artefacts": []}, EVERY[2], "run r1 lists no fit: reconstruct the scene again"),
        ({"artefacts": ["../../x"]}, ("catalog", "delete", "r1", "--yes"), "is no place in the"),
    ],
)
def test_a_damaged_row(store, changes, words, expected):
    store.tables.merge("runs", [RUN | changes])
    refused(store, words, expected)


def test_a_run_is_not_opened_on_another_content_of_its_scene(store):
    store.tables.merge("runs", [RUN | {"scene_digest": store.scene_digest(TOY_SCENE)}])
    record_scene(store, write_toy_scene(store.root))  # read again, the same
    assert open_run(store, "r1").scene_id == TOY_SCENE
    record_scene(store, write_toy_scene(store.root, num_frames=3))
    for words in EVERY[2:]:
        refused(store, words, "run r1 was made of another content of toy/street: reconstruct the")
    assert call("catalog", "delete", "r1", "--yes", store=store).code == 0


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"files": [1]}, "files is no dict; the scene is damaged"),
        ({"arrays": 7}, "arrays is no dict; the scene is damaged"),
        ({"camera_names": None}, "camera_names is no list; the scene is damaged"),
    ],
)
@pytest.mark.parametrize("words", [("reconstruct", TOY_SCENE), ("doctor", TOY_SCENE)])
def test_a_manifest_that_holds_something_else(store, changes, expected, words):
    path = store.scene_folder(TOY_SCENE) / "manifest.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))
    refused(store, words, expected)
