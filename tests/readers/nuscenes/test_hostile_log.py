"""A bad nuScenes log gets one clear line with file and row, and leaves nothing behind."""

import os

import numpy as np
import pytest

from lidarpainter_models.errors import DataError, LidarPainterError
from lidarpainter_models.readers.nuscenes.reader import list_nuscenes_scenes
from lidarpainter_models.readers.nuscenes.tables import MAX_ROW_BYTES, NuscenesTable


def refusal(log, store, **options):
    with pytest.raises(LidarPainterError) as raised:
        log.ingest(store, **options)
    assert [path for path in store.rglob("*") if path.is_file()] == []
    message = str(raised.value)
    assert "\n" not in message
    assert type(raised.value) is DataError
    return message


def set_in(key, value, number=0):
    def change(rows):
        rows[number][key] = value

    return change


def set_sweep(key, value):
    def change(rows):
        next(row for row in rows if "/LIDAR_TOP/" in row["filename"])[key] = value

    return change


NAN, ENDLESS = float("nan"), 10**400
CASES = [
    ("sample_data", set_in("ego_pose_token", "f" * 32), "refers to token 'fff"),
    ("sample_data", set_in("calibrated_sensor_token", "f" * 32), "refers to token 'fff"),
    ("sample_annotation", set_in("instance_token", "gone"), "refers to token 'gone'"),
    ("ego_pose", lambda rows: rows + rows[:1], "stands in 2 rows"),
    ("scene", lambda rows: rows + rows[:1], "name 'scene-0061' stands in 2 rows"),
    ("sample_data", lambda rows: rows + rows[:1], "has another row of the same time"),
    ("sample_annotation", lambda rows: rows + rows[:1], "has another box of instance"),
    ("sample", lambda rows: rows[:1], "states 2 samples"),
    ("scene", set_in("nbr_samples", 0), "states 0 samples"),
    ("sample", set_in("timestamp", -5), "timestamp is -5, expected whole microseconds"),
    ("sample", set_in("timestamp", True), "timestamp is True, expected whole microseconds"),
    ("sample", set_in("timestamp", 2**62), "expected whole microseconds"),
    ("ego_pose", set_in("translation", [NAN, 0, 0]), "translation is [nan, 0, 0], expected 3"),
    ("ego_pose", set_in("translation", [ENDLESS, 0, 0]), "expected 3 finite numbers"),
    ("ego_pose", set_in("translation", [1, 2]), "translation is [1, 2], expected 3 finite"),
    ("ego_pose", set_in("rotation", [0, 0, 0, 0]), "expected a unit quaternion"),
    ("ego_pose", set_in("rotation", "upright"), "rotation is 'upright', expected 4 finite"),
    ("sample_annotation", set_in("size", [1, 0, 1]), "expected positive sizes"),
    ("sample_annotation", set_in("size", None), "size is None, expected 3 finite numbers"),
    ("instance", set_in("token", "../x"), "refers to token"),
    ("category", set_in("name", ""), "name is '', expected a text"),
    ("calibrated_sensor", set_in("camera_intrinsic", [], 2), "expected 3 x 3 finite numbers"),
    ("calibrated_sensor", set_in("camera_intrinsic", [[1, 0, 1]] * 3, 2), "and no skew"),
    ("sample_data", set_in("filename", "../../../etc/passwd"), "expected a path below the root"),
    ("sample_data", set_in("filename", "/etc/passwd"), "expected a path below the root"),
    ("sample_data", set_in("filename", "a\x00b"), "expected a path below the root"),
    ("sample_data", set_in("filename", "\ud800"), "expected a path below the root"),
    ("sample_data", set_in("filename", "x" * 5000), "cannot be read (File name too long)"),
    ("sample_data", set_in("filename", "samples"), "/log/samples: "),
    ("sample_data", set_in("filename", "samples/none.jpg"), "none.jpg: the file is missing"),
    ("sample_data", set_in("is_key_frame", "yes"), "is_key_frame is 'yes', expected true or"),
    ("sample_data", set_in("width", 97), "the image is 96 x 54 px, expected 97 x 54"),
    ("sample_data", set_in("width", -1), "width is -1, expected a count"),
    ("sample_data", set_sweep("is_key_frame", False), "no key frame of LIDAR_TOP"),
    ("sensor", set_in("channel", ["LIDAR_TOP"]), "channel is ['LIDAR_TOP'], expected a text"),
    ("sample_data", lambda _: {"rows": 1}, "byte 0: expected '['"),
    ("sample_data", lambda _: [1, 2], "byte 1: an entry of the array is no row, expected [{"),
    ("sample_data", lambda _: [{"token": 3}], "row 0: sample_token is no text but None"),
]


@pytest.mark.parametrize(("table", "change", "expected"), CASES)
def test_senseless_row(log, store, table, change, expected):
    log.edit(table, change)
    message = refusal(log, store)
    assert expected in message
    assert str(log.root) in message


def test_instance_that_is_no_name(log, store):
    log.edit("instance", set_in("token", "../../x"))
    log.edit("sample_annotation", lambda rows: [{**rows[0], "instance_token": "../../x"}])
    message = refusal(log, store)
    assert "instance.json, token '../../x': actor name '../../x' cannot be used" in message


def test_two_samples_at_one_time(log, store):
    when = log.rows("sample")[0]["timestamp"]
    log.edit("sample", set_in("timestamp", when, 1))
    assert "another sample of the scene has the same time" in refusal(log, store)


def test_two_key_sweeps_of_one_sample(log, store):
    second = log.rows_of("LIDAR_TOP")[1]

    def change(rows):
        for row in rows:
            if row["token"] == second["token"]:
                row["is_key_frame"] = True

    log.edit("sample_data", change)
    assert "another key frame of LIDAR_TOP" in refusal(log, store)


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
    assert refusal(log, store).endswith("category.json: not a file")


@pytest.mark.parametrize("share", [0.0, 0.3, 0.9, 0.999])
def test_truncated_table(log, store, share):
    path = log.folder / "ego_pose.json"
    content = path.read_bytes()
    path.write_bytes(content[: int(share * len(content))])
    message = refusal(log, store)
    assert "ego_pose.json, byte " in message


def sweep_file(log):
    return log.root / log.rows_of("LIDAR_TOP")[1]["filename"]


def write_points(file, change):
    rows = np.frombuffer(file.read_bytes(), "<f4").reshape(-1, 5).copy()
    change(rows)
    file.write_bytes(rows.tobytes())


@pytest.mark.parametrize("kept", [1, 19, 21, -1, -19])
def test_truncated_sweep(log, store, kept):
    file = sweep_file(log)
    file.write_bytes(file.read_bytes()[:kept])
    message = refusal(log, store)
    assert f"{file.name}: " in message
    assert "expected whole points of 20 bytes" in message


def test_sweep_of_more_than_a_turn(log, store, monkeypatch):
    monkeypatch.setattr("lidarpainter_models.readers.nuscenes.sweeps._MAX_FILE_BYTES", 100)
    message = refusal(log, store)
    assert message.endswith(": more than 100 bytes, expected one turn of a LiDAR")


def test_empty_sweep(log, store):
    sweep_file(log).write_bytes(b"")
    assert "zero points beyond 1.0 m, expected at least one" in refusal(log, store)


@pytest.mark.parametrize(("column", "value"), [(0, np.nan), (3, np.inf), (4, -np.inf)])
def test_sweep_of_no_numbers(log, store, column, value):
    def change(rows):
        rows[7, column] = value

    write_points(sweep_file(log), change)
    assert "point 7: holds something other than finite numbers" in refusal(log, store)


@pytest.mark.parametrize(
    ("column", "value", "expected"),
    [
        (4, 0.5, "point 7: ring 0.5 is no laser"),
        (4, -1, "point 7: ring -1.0 is no laser"),
        (4, 1e9, "is no laser"),
        (0, 3e38, "point 7: 3e+38 m from the sensor"),
    ],
)
def test_senseless_point(log, store, column, value, expected):
    def change(rows):
        rows[7, column] = value

    write_points(sweep_file(log), change)
    assert expected in refusal(log, store)


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


def test_table_of_no_rows_is_empty(tmp_path):
    (tmp_path / "rows.json").write_text(" [\n] ")
    assert len(NuscenesTable(tmp_path / "rows.json")) == 0
    assert NuscenesTable(tmp_path / "rows.json").rows_with("a") == []


def test_row_that_is_not_utf8_is_refused_when_read(tmp_path):
    path = tmp_path / "rows.json"
    path.write_bytes(b'[{"token":"a","x":"\xff"},{"token":"b"}]')
    table = NuscenesTable(path)
    assert table.row("b", "test").values == {"token": "b"}
    with pytest.raises(DataError, match=r"rows\.json, row 0: not a row in UTF-8"):
        table.row("a", "test")
