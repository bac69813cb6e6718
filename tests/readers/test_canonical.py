"""A scene written elsewhere comes into the store whole, and a damaged or hostile one does not."""

import json
import os
import shutil
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from parquet_footers import understate

from lidarpainter_models.errors import DataError, LidarPainterError
from lidarpainter_models.readers import ingest_scene, list_sequences
from lidarpainter_models.readers.canonical import checks
from lidarpainter_models.readers.canonical.checks import zstd_content_size
from lidarpainter_models.scenes import schema
from lidarpainter_models.scenes.driving_scene import DrivingScene
from lidarpainter_models.scenes.stored import content_digest


@pytest.fixture
def foreign(small_scene, tmp_path):
    """A scene folder from elsewhere that a test may damage."""
    folder = tmp_path / "elsewhere/002"
    shutil.copytree(small_scene.path, folder)
    return folder


def ingested(folder, store, **options):
    return ingest_scene("canonical", folder.parent, folder.name, store, **options)


def refusal(folder, tmp_path):
    """The one line a scene is refused with; the store is empty afterwards."""
    store = tmp_path / "store"
    with pytest.raises(LidarPainterError) as raised:
        ingested(folder, store)
    assert [path for path in store.rglob("*") if path.is_file()] == []
    message = str(raised.value)
    assert "\n" not in message
    assert str(folder) in message
    return message


def edit_manifest(folder, change):
    file = folder / "manifest.json"
    manifest = json.loads(file.read_text())
    change(manifest)
    file.write_text(json.dumps(manifest))


def test_scene_from_elsewhere_keeps_its_name_and_every_byte_of_content(foreign, tmp_path):
    path = ingested(foreign, tmp_path / "store")
    assert path == tmp_path / "store/scenes/pandaset/002"
    original = json.loads((foreign / "manifest.json").read_text())
    assert DrivingScene.open(path).content_digest == original["content_digest"]
    arrays = [file.relative_to(foreign) for file in (foreign / "scene.zarr").rglob("c/*")]
    arrays = [file for file in arrays if (foreign / file).is_file()]
    assert arrays
    assert all((path / file).read_bytes() == (foreign / file).read_bytes() for file in arrays)


def test_times_in_another_unit_are_told_by_the_speed_that_they_make(foreign, tmp_path):
    for name in ("frames", "cameras", "sweeps", "boxes"):
        rewrite_table(
            foreign,
            name,
            lambda table: type(table).from_pylist(
                [{**row, "timestamp_ns": row["timestamp_ns"] // 1000} for row in table.to_pylist()],
                schema=table.schema,
            ),
        )
    assert "500 m/s at most: are the times in nanoseconds?" in refusal(foreign, tmp_path)


def test_entries_that_the_format_does_not_know_stay_behind(foreign, tmp_path):
    known = {"global_frame": "map", "generator": {"name": "a street"}, "stress": {"level": 1}}
    known |= {"poses": "localised", "labelled": {"car-1": 0.7}}
    edit_manifest(foreign, lambda manifest: manifest.update(known, invented=[1]))
    manifest = DrivingScene.open(ingested(foreign, tmp_path / "store")).manifest
    assert {key: manifest.get(key) for key in (*known, "invented")} == {**known, "invented": None}


def test_scenes_below_a_root_and_a_scene_itself_are_found(foreign):
    assert list_sequences("canonical", foreign.parent) == ("002",)
    assert list_sequences("canonical", foreign) == ("002",)
    with pytest.raises(DataError, match="no canonical sequence found"):
        list_sequences("canonical", foreign / "scene.zarr")


def test_root_may_be_the_scene_itself(foreign, tmp_path):
    path = ingest_scene("canonical", foreign, "002", tmp_path / "store")
    assert DrivingScene.open(path).frame_indices == (0, 1, 2)


def test_lens_and_shutter_survive(foreign, tmp_path):
    lens = {
        "distortion_model": "brown",
        "distortion_terms": [-0.1, 0.01, 0.001, 0.0, 0.0],
        "rolling_shutter_s": 0.03,
        "rolling_shutter_direction": "left",
        "rolling_shutter_first_row_s": -0.02,
    }
    rewrite_table(foreign, "cameras", lambda found: changed_rows(found, **lens))
    row = pq.read_table(ingested(foreign, tmp_path / "s") / "cameras.parquet").to_pylist()[1]
    assert {key: row[key] for key in lens} == lens


def test_a_scene_of_the_first_version_still_opens_and_comes_in(foreign, tmp_path):
    rewrite_table(foreign, "cameras", lambda table: table.drop(["rolling_shutter_first_row_s"]))
    edit_manifest(foreign, lambda manifest: manifest.update(schema_version=1))
    old = DrivingScene.open(foreign)
    old.verify_content()
    new = DrivingScene.open(ingested(foreign, tmp_path / "store"))
    assert new.manifest["schema_version"] == schema.SCHEMA_VERSION
    for before, after in zip(old.views, new.views, strict=True):
        assert before.timestamp_ns == after.timestamp_ns
        assert before.camera.centre_world.tolist() == after.camera.centre_world.tolist()


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (lambda m: m.update(is_complete=False), "is_complete is not true"),
        (lambda m: m.update(schema_version=3), "schema_version is 3, expected 2"),
        (lambda m: m.update(sequence="../x"), "name '../x' cannot be used"),
        (lambda m: m.update(dataset="x" * 129), "cannot be used: expected at most 128"),
        (lambda m: m.update(camera_names=["a/b"]), "name 'a/b' cannot be used"),
        (lambda m: m.update(global_from_world=[1.0] * 15), "no list of 16 numbers"),
        (lambda m: m.update(global_from_world=[float("nan")] * 16), "no list of 16 numbers"),
        (lambda m: m.update(licence=None), "licence is no text"),
        (lambda m: m.update(global_frame=["map"]), "global_frame is no text"),
        (lambda m: m.update(poses=["none"]), "poses says none of none, localised"),
        (lambda m: m.update(poses="guessed"), "poses says none of none, localised"),
        (lambda m: m.update(labelled=["car-1"]), "labelled is no object of scores by actor"),
        (lambda m: m.update(labelled={"car-1": "high"}), "labelled is no object of scores"),
        (lambda m: m.update(labelled={"../car": 0.5}), "name '../car' cannot be used"),
        (lambda m: m.update(global_frame="pandaset/002"), "name 'pandaset/002' cannot be used"),
        (lambda m: m["files"].update({"../../x": 1}), "leaves the scene"),
        (lambda m: m["files"].update({"/etc/passwd": 1}), "leaves the scene"),
        (lambda m: m["files"].update({"missing": 1}), "missing, but the manifest lists it"),
        (lambda m: m["files"].update({"frames.parquet": 1}), "expected a file of 1"),
        (lambda m: m["tables"].pop("boxes"), "tables must be"),
        (lambda m: m["arrays"].update(x={}), "arrays must be"),
        (lambda m: m["arrays"]["point_ring"].update(shape=[10**12]), "differ in length"),
        (lambda m: m["arrays"]["point_ring"].update(dtype="object"), "is not int16"),
        (lambda m: m["arrays"]["point_ring"].update(sha256="0"), "has no sha256"),
        (lambda m: m["tables"]["boxes"].update(sha256="0" * 64), "is not what was written"),
        (lambda m: m["arrays"]["point_ring"].update(sha256="0" * 64), "is not what was written"),
        (lambda m: m.update(semantic_classes={"²": "x"}), "no class number"),
    ],
)
def test_manifest_that_lies_is_refused(foreign, tmp_path, change, expected):
    edit_manifest(foreign, change)
    assert expected in refusal(foreign, tmp_path)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("codecs", [{"name": "bytes"}, {"name": "numcodecs.pickle"}]),
        ("data_type", "variable_length_bytes"),
        ("shape", [10**12]),
        ("chunk_grid", {"name": "regular", "configuration": {"chunk_shape": [10**12]}}),
        ("fill_value", 7),
        ("zarr_format", 2),
        ("extra", True),
    ],
)
def test_array_metadata_is_taken_word_for_word(foreign, tmp_path, key, value):
    file = foreign / "scene.zarr/point_ring/zarr.json"
    changed = json.dumps({**json.loads(file.read_text()), key: value})
    file.write_text(changed)
    edit_manifest(
        foreign, lambda m: m["files"].update({"scene.zarr/point_ring/zarr.json": len(changed)})
    )
    assert "point_ring/zarr.json: " in refusal(foreign, tmp_path)


def test_chunk_that_states_more_than_a_chunk_is_refused(foreign, tmp_path):
    file = foreign / "scene.zarr/point_ring/c/0"
    content = bytearray(file.read_bytes())
    content[5:9] = (2**31).to_bytes(4, "little")
    file.write_bytes(content)
    assert "no Zstandard frame that states" in refusal(foreign, tmp_path)


def test_header_of_a_frame_without_a_size_tells_none():
    assert zstd_content_size(b"") is None
    assert zstd_content_size(b"\x28\xb5\x2f\xfd" + bytes(14)) is None
    assert zstd_content_size(b"\x28\xb5\x2f\xfd\x20\x07" + bytes(12)) == 7


def test_link_in_a_scene_is_refused(foreign, tmp_path):
    (foreign / "link").symlink_to("/etc")
    assert "is a link" in refusal(foreign, tmp_path)


@pytest.mark.parametrize("name", ["frames.parquet", "scene.zarr/point_ring/c/0"])
def test_pipe_that_the_manifest_does_not_list_is_refused(foreign, tmp_path, name):
    edit_manifest(foreign, lambda m: m["files"].pop(name))
    (foreign / name).unlink()
    os.mkfifo(foreign / name)
    assert f"{name}: is a link or a pipe" in refusal(foreign, tmp_path)


def rewrite_table(folder, name, change):
    """Write a table anew and make the manifest agree with it."""
    file = folder / f"{name}.parquet"
    table = change(pq.read_table(file))
    pq.write_table(table, file)

    def agree(manifest):
        manifest["files"][file.name] = file.stat().st_size
        manifest["tables"][name]["sha256"] = content_digest(table.to_pylist())

    edit_manifest(folder, agree)


def changed_rows(table, **columns):
    rows = [{**row, **columns} for row in table.to_pylist()]
    return type(table).from_pylist(rows, schema=table.schema)


@pytest.mark.parametrize(
    ("table", "columns", "expected"),
    [
        ("cameras", {"frame_index": 9}, "frame 9 is not in the table of frames"),
        ("cameras", {"fx_px": float("nan")}, "finite lens"),
        ("cameras", {"width_px": 65}, "is 64 x 48 px, expected"),
        ("cameras", {"offset": 2**40}, "rows 1099511627776"),
        ("cameras", {"num_bytes": 2**40}, "cameras.parquet: 19791209299968 num_bytes in all"),
        ("cameras", {"num_bytes": -1}, "an image of -1 bytes"),
        ("cameras", {"distortion_model": "magic"}, "'magic' is not known"),
        ("cameras", {"rolling_shutter_direction": None}, "reads in no known direction"),
        ("sweeps", {"num_points": -1}, "a sweep of -1 points"),
        ("sweeps", {"lidar": "../x"}, "cannot be used"),
        ("boxes", {"actor_id": "../x"}, "cannot be used"),
        ("boxes", {"category": "a\nb"}, "printable"),
        ("boxes", {"length_m": float("nan")}, "expected positive sizes"),
        ("boxes", {"num_points": -1}, "holds -1 points"),
        ("boxes", {"timestamp_ns": 2**62}, "no date of a log"),
        ("frames", {"world_from_ego": [0.0] * 16}, "not a rotation"),
        ("frames", {"timestamp_ns": 5}, "expected a later frame"),
    ],
)
def test_senseless_row_is_refused_though_its_digest_is_right(
    foreign, tmp_path, table, columns, expected
):
    rewrite_table(foreign, table, lambda found: changed_rows(found, **columns))
    assert expected in refusal(foreign, tmp_path)


@pytest.mark.parametrize(("table", "length"), [("cameras", "num_bytes"), ("sweeps", "num_points")])
def test_rows_that_share_one_stretch_are_refused(foreign, tmp_path, table, length):
    def share(found):
        longest = max(found.to_pylist(), key=lambda row: row[length])
        return changed_rows(found, **{key: longest[key] for key in ("offset", length)})

    rewrite_table(foreign, table, share)
    assert "no rows share any" in refusal(foreign, tmp_path)


def test_text_that_all_rows_repeat_is_refused_before_it_is_unpacked(foreign, tmp_path, monkeypatch):
    monkeypatch.setattr(checks, "MAX_TEXT_BYTES", 1 << 20)
    file = foreign / "boxes.parquet"
    row = {**pq.read_table(file).to_pylist()[0], "category": "x" * 10_000}
    pq.write_table(pa.Table.from_pylist([row] * 1000, schema=schema.arrow_schema("boxes")), file)
    assert file.stat().st_size < 50_000
    edit_manifest(foreign, lambda m: m["files"].update({file.name: file.stat().st_size}))
    pool, usual = pa.proxy_memory_pool(pa.default_memory_pool()), pa.default_memory_pool()
    pa.set_memory_pool(pool)
    try:
        assert "category has more than 1048576 bytes of texts" in refusal(foreign, tmp_path)
    finally:
        pa.set_memory_pool(usual)
    assert pool.max_memory() < 2 << 20


def test_table_that_states_more_than_it_may_unpack_to_is_refused(foreign, tmp_path, monkeypatch):
    monkeypatch.setattr(checks, "MAX_TABLE_BYTES", 100)
    assert "expected 100 at most" in refusal(foreign, tmp_path)


def test_table_that_unpacks_to_more_than_it_states_is_refused(foreign, tmp_path, monkeypatch):
    monkeypatch.setattr(checks, "MAX_TABLE_BYTES", 1 << 20)
    file = foreign / "boxes.parquet"
    row = {**pq.read_table(file).to_pylist()[0], "category": "x" * (4 << 20)}
    table = pa.Table.from_pylist([row], schema=schema.arrow_schema("boxes"))
    pq.write_table(table, file, compression="zstd")
    understate(file)
    edit_manifest(foreign, lambda m: m["files"].update({file.name: file.stat().st_size}))
    assert "bytes, expected 1048576 at most" in refusal(foreign, tmp_path)


def test_column_of_another_type_is_refused(foreign, tmp_path):
    rewrite_table(foreign, "sweeps", lambda table: table.drop_columns(["lidar"]))
    assert "not those of the format" in refusal(foreign, tmp_path)


def test_zarr_metadata_of_the_writer_is_that_of_the_format(small_scene):
    for name, layout in schema.ARRAYS.items():
        found = json.loads((small_scene.path / "scene.zarr" / name / "zarr.json").read_text())
        expected = schema.zarr_metadata(layout, found["shape"][0])
        found["codecs"][1] = {"name": found["codecs"][1]["name"]}
        assert {key: found[key] for key in expected} == expected


def test_every_column_and_array_stands_in_the_specification():
    text = (Path(__file__).resolve().parents[2] / "docs/canonical-format.md").read_text("utf-8")
    for columns in schema.TABLES.values():
        for column in columns:
            assert f"| {column.name} |" in text
            assert column.description in text
    for layout in schema.ARRAYS.values():
        assert f"| {layout.name} | {layout.dtype.name} |" in text
        assert f"| {layout.chunk_rows} |" in text
