"""A bad nuScenes log gets one clear line with file and row, and leaves nothing behind."""

import os

import numpy as np
import pytest

from lidarpainter_models.errors import DataError
from lidarpainter_models.readers.nuscenes.reader import list_nuscenes_scenes
from lidarpainter_models.readers.nuscenes.tables import MAX_ROW_BYTES, NuscenesTable


def set_in(key, value, number=0):
    def change(rows):
        rows[number][key] = value

    return change


def set_sweep(key, value):
    def change(rows):
        next(row for row in rows if "/LIDAR_TOP/" in row["filename"])[key] = value

    return change


NAN = float("nan")
CASES = [
    ("sample_data", set_in("ego_pose_token", "f" * 32), "refers to token 'fff"),
    ("sample_annotation", set_in("instance_token", "gone"), "refers to token 'gone'"),
    ("ego_pose", lambda rows: rows + rows[:1], "stands in 2 rows"),
    ("sample_data", lambda rows: rows + rows[:1], "has another row of the same time"),
    ("sample_annotation", lambda rows: rows + rows[:1], "has another box of instance"),
    ("scene", set_in("nbr_samples", 0), "states 0 samples"),
    ("sample", set_in("timestamp", -5), "timestamp is -5, expected whole microseconds"),
    ("ego_pose", set_in("translation", [NAN, 0, 0]), "translation is [nan, 0, 0], expected 3"),
    ("ego_pose", set_in("rotation", [0, 0, 0, 0]), "expected a unit quaternion"),
    ("sample_annotation", set_in("size", [1, 0, 1]), "expected positive sizes"),
    ("calibrated_sensor", set_in("camera_intrinsic", [], 2), "expected 3 x 3 finite numbers"),
    ("sample_data", set_in("filename", "../../../etc/passwd"), "expected a path below the root"),
    ("sample_data", set_in("filename", "\ud800"), "expected a path below the root"),
    ("sample_data", set_in("filename", "x" * 5000), "cannot be read (File name too long)"),
    ("sample_data", set_in("is_key_frame", "yes"), "is_key_frame is 'yes', expected true or"),
    ("sample_data", set_in("width", 97), "the image is 96 x 54 px, expected 97 x 54"),
    ("sample_data", set_sweep("is_key_frame", False), "no key frame of LIDAR_TOP"),
    ("sample_data", lambda _: {"rows": 1}, "byte 0: expected '['"),
    ("sample_data", lambda _: [1, 2], "byte 1: an entry of the array is no row, expected [{"),
]


@pytest.mark.parametrize(("table", "change", "expected"), CASES)
def test_senseless_row(log, store, table, change, expected):
    log.edit(table, change)
    assert expected in log.refusal(store)


def test_instance_that_is_no_name(log, store):
    log.edit("instance", set_in("token", "../../x"))
    log.edit("sample_annotation", lambda rows: [{**rows[0], "instance_token": "../../x"}])
    message = log.refusal(store)
    assert "instance.json, token '../../x': actor name '../../x' cannot be used" in message


@pytest.mark.parametrize("content", ['[{"token": "a", "name"', "[{]", "[nothing]"])
def test_table_that_breaks_off_is_named_with_what_was_expected(log, store, content):
    path = log.folder / "scene.json"
    path.write_text(content)
    for ask in (lambda: list_nuscenes_scenes(log.root), lambda: log.ingest(store)):
        with pytest.raises(DataError) as raised:
            ask()
        line = f"{path}, byte 1: not a complete JSON row, expected [{{...}}, {{...}}, ...]"
        assert str(raised.value) == line


def test_table_that_never_ends(log, store):
    path = log.folder / "category.json"
    path.unlink()
    os.mkfifo(path)
    assert log.refusal(store).endswith("category.json: not a file")


def sweep_file(log):
    return log.root / log.rows_of("LIDAR_TOP")[1]["filename"]


def write_points(file, change):
    rows = np.frombuffer(file.read_bytes(), "<f4").reshape(-1, 5).copy()
    change(rows)
    file.write_bytes(rows.tobytes())


@pytest.mark.parametrize("kept", [1, -1])
def test_truncated_sweep(log, store, kept):
    file = sweep_file(log)
    file.write_bytes(file.read_bytes()[:kept])
    message = log.refusal(store)
    assert f"{file.name}: " in message
    assert "expected whole points of 20 bytes" in message


def test_sweep_of_more_than_a_turn(log, store, monkeypatch):
    monkeypatch.setattr("lidarpainter_models.readers.nuscenes.sweeps._MAX_FILE_BYTES", 100)
    message = log.refusal(store)
    assert message.endswith(": more than 100 bytes, expected one turn of a LiDAR")


@pytest.mark.parametrize(
    ("column", "value", "expected"),
    [
        (0, np.nan, "point 7: holds something other than finite numbers"),
        (4, 0.5, "point 7: ring 0.5 is no laser"),
        (0, 3e38, "point 7: 3e+38 m from the sensor"),
    ],
)
def test_senseless_point(log, store, column, value, expected):
    def change(rows):
        rows[7, column] = value

    write_points(sweep_file(log), change)
    assert expected in log.refusal(store)


@pytest.mark.parametrize("blank", ["", " \n\t\r"])
def test_rows_are_found_wherever_chunks_end(tmp_path, monkeypatch, blank):
    path = tmp_path / "rows.json"
    rows = [{"token": f"tök\\u00{i:02x}", "x": ["}", i]} for i in range(0x20, 0x40)]
    text = f"{blank},{blank}".join(str(row).replace("'", '"') for row in rows)
    path.write_text(f"{blank}[{blank}{text}{blank}]{blank}".replace("\\\\", "\\"), "utf-8")
    whole = [row.values for row in NuscenesTable(path).rows()]
    assert [row["x"][1] for row in whole] == list(range(0x20, 0x40))
    for chunk_bytes in (1, 2, 3, 7, 64):
        monkeypatch.setattr("lidarpainter_models.readers.nuscenes.tables._CHUNK_BYTES", chunk_bytes)
        table = NuscenesTable(path)
        assert [row.values for row in table.rows()] == whole
        for row in whole:
            assert table.row(row["token"], "test").values == row


@pytest.mark.parametrize(
    "content",
    [
        *("[", "[{}", '[{"token":"a"},]', '[{"token":"a"} {"token":"b"}]', '[{"token":"a"}] x'),
        *("[[]]", "[" * 100_000, '[{"a":' + "[" * 100_000, '[{"a":' + "9" * 5000 + "}]"),
        *("null", "\ufeff[]", f'[{{"token":"{"x" * MAX_ROW_BYTES}"}}]'),
    ],
)
def test_damaged_table_names_the_place(tmp_path, content):
    path = tmp_path / "rows.json"
    path.write_text(content, "utf-8")
    with pytest.raises(DataError, match=r"rows\.json, (byte|row) \d+: "):
        NuscenesTable(path)


def test_row_that_is_not_utf8_is_refused_when_read(tmp_path):
    path = tmp_path / "rows.json"
    path.write_bytes(b'[{"token":"a","x":"\xff"},{"token":"b"}]')
    table = NuscenesTable(path)
    assert table.row("b", "test").values == {"token": "b"}
    with pytest.raises(DataError, match=r"rows\.json, row 0: not a row in UTF-8"):
        table.row("a", "test")
