"""A bad log gets one clear line, nothing of it is run, and no half-written scene is left."""

import gzip
import os
import pickle
import shutil
import struct

import numpy as np
import pytest
from fuzzing import judge
from pickled_tables import pickled_table

from lidarpainter_models.errors import DataError, LidarPainterError, UnsafePickleError
from lidarpainter_models.readers.pandaset import dataframe_pickle
from lidarpainter_models.readers.pandaset.dataframe_pickle import read_table_bytes
from lidarpainter_models.scenes.driving_scene import DrivingScene


def refusal(log, store, kind=DataError):
    """The one line a log is refused with, after checking that nothing was left in the store."""
    with pytest.raises(LidarPainterError) as raised:
        log.ingest(store)
    assert type(raised.value) is kind
    assert [path for path in store.rglob("*") if path.is_file()] == []
    message = str(raised.value)
    assert "\n" not in message
    return message


def test_missing_camera_folder(pandaset, store):
    shutil.rmtree(pandaset.path / "camera/left_camera")
    message = refusal(pandaset, store)
    place, expected = message.split("; to read the others alone: --cameras ")
    assert place.endswith("camera/left_camera: the camera folder is missing")
    cameras = tuple(expected.split(","))
    scene = DrivingScene.open(pandaset.ingest(store, cameras=cameras))
    assert set(scene.camera_names) == set(cameras)
    assert len(cameras) == 5


@pytest.mark.parametrize("kept", [0, -2])
def test_truncated_image(pandaset, store, kept):
    file = pandaset.path / "camera/front_camera/01.jpg"
    file.write_bytes(file.read_bytes()[:kept])
    message = refusal(pandaset, store)
    assert "front_camera/01.jpg: " in message
    assert "JPEG" in message


NAN_X = {"x": float("nan")}


@pytest.mark.parametrize(
    ("name", "change", "expected"),
    [
        ("lidar/poses", lambda p: p[1]["position"].update(NAN_X), "poses.json, frame 1: x is nan"),
        ("lidar/poses", lambda p: p[2]["heading"].update(w=7.0), "frame 2: the heading is no unit"),
        ("camera/back_camera/intrinsics", lambda lens: lens.update(fx=-1), "must be positive"),
    ],
)
def test_senseless_json(pandaset, store, name, change, expected):
    pandaset.edit_json(f"{name}.json", change)
    message = refusal(pandaset, store)
    assert f"{name}.json" in message
    assert expected in message


def empty_points(num_points=0):
    columns = {axis: np.zeros(num_points) for axis in "xyzit"}
    return {**columns, "d": np.zeros(num_points, dtype=np.int64)}


@pytest.mark.parametrize(
    ("columns", "expected"),
    [
        (empty_points(), "zero points of a known LiDAR, expected at least one"),
        ({**empty_points(5), "y": np.full(5, np.inf)}, "points or their times are not finite"),
        (
            {name: column for name, column in empty_points(5).items() if name != "t"},
            "no column t; it has x, y, z, i, d",
        ),
        (
            {**empty_points(2), "y": np.array(["a", "b"], dtype=object)},
            "column y: holds something other than numbers",
        ),
    ],
)
def test_senseless_points(pandaset, store, columns, expected):
    pandaset.write_table("lidar/01.pkl.gz", columns)
    message = refusal(pandaset, store)
    assert "lidar/01.pkl.gz" in message
    assert expected in message


def test_box_of_no_size(pandaset, store, monkeypatch):
    monkeypatch.setattr(f"{type(pandaset).__module__}.CAR_SIZE_M", (4.0, 1e308, 1.6))
    boxes = [{"uuid": "flat", "stationary": True, "sensor": -1, "sibling": "-"}]
    pandaset.write_boxes(1, [{**box, "centre": np.array([110.0, -40.0, 7.0])} for box in boxes])
    message = refusal(pandaset, store)
    assert "01.pkl.gz, Car flat: the box measures 4 x 1e+308 x 1.6 m, expected" in message


def test_truncated_gzip(pandaset, store):
    file = pandaset.path / "lidar/02.pkl.gz"
    file.write_bytes(file.read_bytes()[:-300])
    message = refusal(pandaset, store)
    assert "lidar/02.pkl.gz: the gzip file is cut off or damaged" in message


@pytest.mark.parametrize("share", [0.1, 0.999])
def test_truncated_pickle(pandaset, store, share):
    file = pandaset.path / "annotations/cuboids/00.pkl.gz"
    content = gzip.decompress(file.read_bytes())
    file.write_bytes(gzip.compress(content[: int(share * len(content))]))
    message = refusal(pandaset, store)
    assert "cuboids/00.pkl.gz: the pickle is damaged" in message


def test_column_at_no_place(tmp_path):
    content = pickled_table({"x": np.ones(1)}).replace(b"i8", b"f8")
    size = struct.pack("<I", 8)
    content = content.replace(size + bytes(8), size + struct.pack("<d", np.inf))
    with pytest.raises(DataError, match="the pandas table is damaged"):
        read_table_bytes(content, tmp_path / "table.pkl")


def test_table_that_unpacks_without_end(tmp_path):
    bomb = gzip.compress(b"\x00" * 10_000_000)
    with pytest.raises(DataError, match="unpacks to more than 1000 bytes"):
        read_table_bytes(bomb, tmp_path / "bomb.pkl.gz", max_bytes=1000)
    assert dataframe_pickle.MAX_TABLE_BYTES < 2**30


def test_gzip_file_of_several_members(tmp_path):
    content = pickled_table({"x": np.arange(3.0)})
    members = [gzip.compress(part) for part in (content[:100], b"", content[100:])]
    table = read_table_bytes(b"".join(members), tmp_path / "table.pkl.gz")
    assert table["x"].tolist() == [0, 1, 2]
    with pytest.raises(DataError, match="more than 16 gzip members, expected a table"):
        read_table_bytes(b"".join([members[1]] * 17), tmp_path / "table.pkl.gz")


class Runs:
    """Would leave a file behind if it were unpickled."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return open, (str(self.path), "w")


def test_pickle_with_a_foreign_class_is_refused_and_not_run(pandaset, store, tmp_path):
    trace = tmp_path / "was-run"
    pandaset.write("lidar/00.pkl.gz", gzip.compress(pickle.dumps(Runs(trace))))
    message = refusal(pandaset, store, UnsafePickleError)
    assert "lidar/00.pkl.gz: the pickle names" in message
    assert "open, which no table needs; nothing of it was run" in message
    assert not trace.exists()


@pytest.mark.parametrize(
    "program",
    [
        b"cos\nsystem\n(S'true'\ntR.",
        b"\x80\x04\x8c\x05posix\x8c\x06system\x93\x8c\x04true\x85R.",
        b"(S'true'\nios\nsystem\n.",
        b"(cos\nsystem\nS'true'\no.",
        b"Pid\n.",
        b"\x82\x01.",
        b"cnumpy\nload\n.",
        b"cpandas.core.frame\nDataFrame.__init__.__globals__\n.",
    ],
)
def test_no_opcode_reaches_a_foreign_name(program, tmp_path):
    with pytest.raises(UnsafePickleError):
        read_table_bytes(program, tmp_path / "table.pkl")


@pytest.mark.parametrize(
    "program",
    [
        *(b"", b".", b"}.", b"R.", b"(t.", b"h\x05."),
        b"r\xff\xff\xff\xff.",
        b"B\xff\xff\xff\xffab.",
        b"\x80\x09N.",
        b"cpandas.core.frame\nDataFrame\n)\x81}b.",
        b"cpandas.core.frame\nDataFrame\n.",
        b"cpandas.core.frame\nDataFrame\n}(X\x01\x00\x00\x00aKub.",
    ],
)
def test_senseless_pickle_is_one_line(program, tmp_path):
    with pytest.raises(DataError) as raised:
        read_table_bytes(program, tmp_path / "table.pkl")
    assert "\n" not in str(raised.value)


def refused_table(log, content, tmp_path):
    log.write("lidar/00.pkl.gz", gzip.compress(content, 1))
    store = tmp_path / "store"
    verdict = judge(
        lambda: log.ingest(store), store=store, sandbox=tmp_path, named=("lidar/00.pkl.gz",)
    )
    assert verdict.outcome == "refused"
    return verdict.error


@pytest.mark.parametrize(
    ("content", "complaint"),
    [
        (lambda: bytes(80_000_000), "unpacks to more than"),
        # a pickle of endless marks
        (lambda: b"\x80\x03" + b"(" * 600_000 + b"t" * 600_000 + b".", "more than 100000 opcodes"),
        # a deep tuple as a key, which must not be hashed
        (lambda: b"\x80\x03}N" + b"\x85" * 90_000 + b"Ns.", "a key is neither"),
        (
            lambda: pickled_table({name: np.zeros(1_000_001, np.int8) for name in "xyzitd"}),
            "1000001 rows, expected at most 1000000",
        ),
    ],
)
def test_table_without_bounds_is_refused_soon(pandaset, tmp_path, content, complaint):
    assert complaint in refused_table(pandaset, content(), tmp_path)


def test_image_that_states_more_than_it_may_is_refused(pandaset, store):
    file = pandaset.path / "camera/front_camera/00.jpg"
    content = bytearray(file.read_bytes())
    start = content.index(b"\xff\xc0") + 5
    content[start : start + 4] = b"\xff\xff\xff\xff"
    file.write_bytes(content)
    assert "states 65535 x 65535 px" in refusal(pandaset, store)


def test_pipe_in_the_place_of_a_file_is_refused(pandaset, store):
    file = pandaset.path / "lidar/00.pkl.gz"
    file.unlink()
    os.mkfifo(file)
    assert refusal(pandaset, store).endswith("not a file")
