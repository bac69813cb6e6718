"""A bad NCore log gets one clear line with its place, runs nothing, and leaves nothing behind."""

import json
import lzma
import os
import pickle
import struct
from contextlib import suppress

import numpy as np
import pytest
from ncore_log import SEQUENCE, write_ncore_log
from numcodecs import blosc
from written_logs import WrittenLog

from lidarpainter_models.errors import DataError
from lidarpainter_models.readers.ncore.stores import ComponentStore

MAIN, LIDAR, FRONT = "", "-main_pandar64", "-ring_front_center"
POSES = "poses/default/dynamic_poses/.zattrs"
BOXES, LENS = "cuboids/default/cuboids/.zattrs", "intrinsics/default/cameras/*/.zattrs"
RAYS = "lidars/*/frames/*/ray_bundle/direction/.zarray"
FRAMES = "lidars/*/frames/.zattrs"


def edit(log, group, pattern, change):
    """Change the JSON of a record of a store."""
    folder = log.root / f"{SEQUENCE}.ncore4{group}.zarr"
    file = sorted(folder.glob(pattern))[0]
    file.write_text(json.dumps(change(json.loads(file.read_text()))))


def first_entry(**changed):
    """Change entries of the first value of a JSON object, or of the first row of its only list."""

    def change(document):
        name, value = next(iter(document.items()))
        rows = [value[0] | changed, *value[1:]] if isinstance(value, list) else value | changed
        return document | {name: rows}

    return change


def entries(**changed):
    return lambda document: document | changed


def parameters(**changed):
    return lambda document: (
        document | {"camera_model_parameters": document["camera_model_parameters"] | changed}
    )


def leaning(document):
    """Poses whose axes are not at right angles."""
    record = next(iter(document.values()))
    for pose in record["poses"]:
        pose[0][1] += 0.5
    return document


def renamed(name):
    return lambda document: {name: next(iter(document.values()))}


CASES = [
    (MAIN, ".zattrs", entries(version="v3"), "expected v4 and one sequence"),
    (LIDAR, ".zattrs", entries(sequence_id="other"), "expected v4 and one sequence"),
    (MAIN, ".zattrs", entries(generic_meta_data=3), "expected v4 and one sequence"),
    (MAIN, POSES, leaning, "expected 1 to 200000 rigid transforms"),
    (MAIN, "poses/default/.zattrs", entries(component_version="v2"), "version 'v2', expected v1"),
    (MAIN, POSES, first_entry(poses=[[1]]), "expected finite numbers, as many as (None, 4, 4)"),
    (MAIN, POSES, first_entry(timestamps_us=[-5]), "expected"),
    (MAIN, POSES, first_entry(timestamps_us=None), "expected finite numbers"),
    (MAIN, POSES, renamed("__import__('os').system('touch x')"), "between two named frames"),
    (MAIN, POSES, renamed("('tub', 'world')"), "nothing ties frame 'rig' to 'world'"),
    (MAIN, POSES, entries(**{"('rig', 'moon')": {"poses": [], "timestamps_us": []}}), "as many as"),
    (MAIN, BOXES, first_entry(track_id="../../x"), "name '../../x' cannot be used"),
    (MAIN, BOXES, first_entry(class_id="line\nbreak"), "the category is 'line"),
    (MAIN, BOXES, first_entry(timestamp_us=1.5), "expected whole numbers"),
    (MAIN, BOXES, first_entry(reference_frame_id="moon"), "nothing ties frame 'moon'"),
    (
        MAIN,
        BOXES,
        first_entry(bbox3={"centroid": [0, 0, 0], "dim": [1, 1, 0], "rot": [0, 0, 0]}),
        "the box measures 1 x 1 x 0 m",
    ),
    (MAIN, BOXES, entries(cuboid_track_observations=[7]), "bbox3 is None, expected a JSON dict"),
    (MAIN, LENS, parameters(focal_length=[0, 0]), "positive focal lengths"),
    (MAIN, LENS, parameters(resolution=[96, 5.5]), "expected whole numbers"),
    (MAIN, LENS, parameters(resolution=[97, 54]), "the image is 96 x 54 px, expected 97 x 54"),
    (MAIN, LENS, parameters(principal_point="middle"), "expected finite numbers"),
    (LIDAR, FRAMES, entries(frames_timestamps_us=[[9, 7]]), "do not ascend"),
    (LIDAR, FRAMES, entries(frames_timestamps_us=[]), "no LiDAR with frames, expected one"),
    (LIDAR, FRAMES, entries(frames_timestamps_us=[[1, 5]]), "the file is missing"),
    (LIDAR, RAYS, entries(shape=[3, 3]), "(3, 3) values, expected ("),
    (LIDAR, RAYS, entries(chunks=[5, 3]), "a chunk cannot be unpacked"),
    (LIDAR, RAYS, entries(shape=[2**30, 3]), "expected at most"),
    (LIDAR, RAYS, entries(chunks=[2**30, 3]), "expected at most"),
    (LIDAR, RAYS, entries(chunks=[0, 3]), "plain or packed by Blosc"),
    (LIDAR, RAYS, entries(dtype="|O"), "values of |O"),
    (LIDAR, RAYS, entries(dtype=[["a", "<f4"]]), "plain or packed by Blosc"),
    (LIDAR, RAYS, entries(compressor={"id": "zlib", "level": 1}), "packed by"),
    (LIDAR, RAYS, entries(dimension_separator="/../"), "plain or packed by Blosc"),
]


@pytest.mark.parametrize(("group", "pattern", "change", "expected"), CASES)
def test_senseless_value(log, tmp_path, group, pattern, change, expected):
    edit(log, group, pattern, change)
    assert expected in log.refusal(tmp_path / "store")
    assert not (tmp_path / "x").exists()


class Bomb:
    """Writes a file when it is unpickled."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return (open, (str(self.path), "w"))


def test_array_that_would_be_unpickled_is_refused_and_nothing_is_run(log, tmp_path):
    pickled = {"id": "pickle", "protocol": 5}
    edit(log, LIDAR, RAYS, entries(dtype="|O", filters=[pickled], compressor=None))
    folder = log.root / f"{SEQUENCE}.ncore4{LIDAR}.zarr"
    chunk = sorted(folder.glob(RAYS))[0].with_name("0.0")
    chunk.write_bytes(pickle.dumps(np.array([Bomb(tmp_path / "ran")], dtype=object)))
    assert "plain or packed by Blosc" in log.refusal(tmp_path / "store")
    assert not (tmp_path / "ran").exists()


def test_record_that_is_a_pipe_ends_in_a_line(log, tmp_path):
    folder = log.root / f"{SEQUENCE}.ncore4{LIDAR}.zarr"
    file = sorted(folder.glob(FRAMES))[0]
    file.unlink()
    os.mkfifo(file)
    log.refusal(tmp_path / "store")


@pytest.fixture(scope="module")
def sound_archive(street, tmp_path_factory):
    root = tmp_path_factory.mktemp("archives")
    write_ncore_log(street, root)
    return WrittenLog("ncore", root, SEQUENCE)


def listing(items, offsets, sizes):
    import cbor2

    return lzma.compress(cbor2.dumps({"items": items, "offset_datas": offsets, "sizes": sizes}))


def archive(path, packed, magic=b"itar", kind=1, start=0, length=None):
    """A file that ends as an indexed tar archive does."""
    header = struct.pack("<4sIQI", magic, kind, start, len(packed) if length is None else length)
    path.write_bytes(packed.ljust(-(-len(packed) // 512) * 512, b"\0") + header.ljust(512, b"\0"))
    return path


@pytest.mark.parametrize(
    ("changed", "expected"),
    [
        ({"magic": b"rati"}, "not an indexed tar archive of NCore V4"),
        ({"kind": 2}, "not an indexed tar archive of NCore V4"),
        ({"start": 2**63}, "expected at most"),
        ({"length": 2**32 - 1}, "expected at most"),
        ({"packed": b"nothing"}, "its list of records is damaged"),
        ({"packed": lzma.compress(b"\x9b" + b"\xff" * 8)}, "its list of records is damaged"),
        ({"packed": lzma.compress(b"\x81" * 100_000)}, "its list of records is damaged"),
        ({"packed": lzma.compress(b"\xd8\x1c\x80")}, "its list of records is damaged"),
        ({"packed": lzma.compress(bytes(1 << 25))}, "its list of records is damaged"),
        ({"packed": listing(["a"], [0], [])}, "its list of records is damaged"),
        ({"packed": listing(["a"], ["b"], [1])}, "its list of records is damaged"),
        ({"packed": listing([".zattrs"], [2**62], [9])}, "9 bytes at 4611686018427387904"),
    ],
)
def test_archive_that_is_none(tmp_path, changed, expected):
    path = tmp_path / "a.ncore4.zarr.itar"
    archive(path, **{"packed": listing([".zattrs"], [0], [1])} | changed)
    with pytest.raises(DataError, match=expected) as raised:
        ComponentStore(path).attributes("")
    assert str(path) in str(raised.value)


def test_short_file_is_no_archive(tmp_path):
    path = tmp_path / "a.ncore4.zarr.itar"
    for content in (b"", b"itar", b"itar" * 200):
        path.write_bytes(content)
        with pytest.raises(DataError, match=str(path)):
            ComponentStore(path)


def test_every_byte_at_the_end_of_an_archive_may_be_wrong(sound_archive, tmp_path):
    log, rng = sound_archive.copied(tmp_path / "log"), np.random.default_rng(0)
    file = log.root / f"{SEQUENCE}.ncore4.zarr.itar"
    sound = file.read_bytes()
    for _ in range(200):
        damaged = bytearray(sound)
        damaged[-int(rng.integers(1, 3000))] ^= 1 << int(rng.integers(8))
        file.write_bytes(damaged)
        with suppress(DataError):
            ComponentStore(file).attributes("poses/default/dynamic_poses")


def test_packed_chunk_that_says_it_is_larger_is_not_unpacked(log, tmp_path):
    folder = log.root / f"{SEQUENCE}.ncore4{LIDAR}.zarr"
    chunk = sorted(folder.glob(RAYS))[0].with_name("0.0")
    packed = bytearray(blosc.compress(bytes(1 << 16), b"lz4", 5))
    packed[4:8] = (2**31 - 1).to_bytes(4, "little")
    chunk.write_bytes(packed)
    assert "a chunk cannot be unpacked" in log.refusal(tmp_path / "store")
