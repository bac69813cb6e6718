"""A bad bag or rig gets one clear line, and leaves nothing behind."""

import shutil

import numpy as np
import pytest
from bag_log import BagScene, RosWriter, _ros_messages
from fuzzing import fuzz
from mcap.writer import CompressionType
from mutations import damaged_bytes

from lidarpainter_models.errors import ConfigError, DataError, LidarPainterError
from lidarpainter_models.readers import ingest_scene, open_log
from lidarpainter_models.readers.bags import chunks
from lidarpainter_models.readers.bags.rig import read_rig
from tasks.ingest.rigs import propose_rig


def refusal(file, store):
    with pytest.raises(LidarPainterError) as raised:
        ingest_scene("mcap", file, file.stem, store)
    assert [path for path in store.rglob("*") if path.is_file()] == []
    message = str(raised.value)
    assert "\n" not in message
    return message


def changed(file, street, topic, change):
    """The street's bag in which one topic's messages are changed."""
    bag = BagScene(street)
    with RosWriter(file) as writer:
        number = 0
        for log_ns, kind, content in bag.messages():
            for name, message in _ros_messages(writer, bag, log_ns, kind, content):
                if topic in name:
                    change(writer, message, number)
                    number += 1
                writer.write(f"/{name}", log_ns, message)
    return file


def back_in_time(writer, message, number):
    if number == 2:
        message.header.stamp = writer.stamp(1_000_000_000)


def no_lens(_writer, message, _number):
    message.k[:] = 0
    message.p[:] = 0


def other_size(_writer, message, _number):
    message.width += 1


def odd_lens(_writer, message, _number):
    message.distortion_model, message.d = "ds", np.ones(5)


def no_rotation(_writer, message, _number):
    message.transforms[0].transform.rotation.w = 9.0


def nowhere(_writer, message, _number):
    message.transforms[0].transform.translation.x = float("nan")


def no_id(_writer, message, _number):
    for box in message.detections:
        box.id = "" if box is message.detections[0] else "../x"


def no_size(_writer, message, _number):
    message.detections[0].bbox.size.y = 0.0


def no_image(_writer, message, _number):
    message.data = message.data[:100]


def no_points(_writer, message, _number):
    message.width += 1


def jumps(_writer, message, number):
    message.transforms[0].transform.translation.x += 1000.0 * (number > 20)


@pytest.mark.parametrize(
    ("topic", "change", "expected"),
    [
        ("camera_info", no_lens, "states no lens, the camera is not calibrated"),
        ("camera_info", other_size, "the image is 96 x 54 px, expected 97 x 54"),
        ("camera_info", odd_lens, "distortion 'ds', expected plumb_bob"),
        ("tf", no_rotation, "is no unit quaternion"),
        ("tf", nowhere, "the pose is not finite"),
        ("detections", no_size, "the box measures"),
        ("image", no_image, "JPEG"),
        ("points", no_points, "points of 24 bytes, holds"),
        ("tf", jumps, "m/s"),
    ],
)
def test_senseless_message(street, tmp_path, topic, change, expected):
    name = topic if topic != "tf" else "tf"
    file = changed(tmp_path / "drive.mcap", street, name, change)
    assert expected in refusal(file, tmp_path / "store")


def test_clock_that_jumps_is_told_and_which_other_there_is(street, tmp_path):
    file = changed(tmp_path / "drive.mcap", street, "points", back_in_time)
    rig = tmp_path / "rig.toml"
    proposed = propose_rig(file)["rig"]
    assert 'clock = "log"' in proposed
    rig.write_text(proposed.replace('clock = "log"', 'clock = "header"'))
    with pytest.raises(DataError) as raised:
        open_log("mcap", file, "drive", rig=rig)
    line = str(raised.value)
    assert "message 2 of /lidars/main_pandar64/points is stamped -1699999999" in line
    assert line.endswith('expected a clock that goes on, or clock = "log" in the rig')


def test_boxes_without_ids_are_not_proposed(street, tmp_path):
    file = changed(tmp_path / "drive.mcap", street, "detections", no_id)
    path = ingest_scene("mcap", file, "drive", tmp_path / "store")
    assert (path / "manifest.json").is_file()


@pytest.fixture
def bag(bags, tmp_path):
    folder = tmp_path / "bag"
    folder.mkdir()
    return shutil.copy(bags / "ros.mcap", folder / "ros.mcap")


@pytest.mark.parametrize("share", [0.0, 0.001, 0.5, 0.999])
def test_bag_that_breaks_off(bag, tmp_path, share):
    content = bag.read_bytes()
    bag.write_bytes(content[: int(share * len(content))])
    message = refusal(bag, tmp_path / "store")
    assert "damaged or broken off" in message
    assert "mcap recover" in message


def test_chunk_that_unpacks_to_more_than_is_read(tmp_path, monkeypatch):
    monkeypatch.setattr(chunks, "MAX_RECORD_BYTES", 1 << 20)
    for compression in (CompressionType.ZSTD, CompressionType.LZ4):
        file = tmp_path / "drive.mcap"
        with RosWriter(file, compression=compression, chunk_size=1 << 30) as writer:
            image = writer.image(0, "eye", bytes(1 << 21))
            writer.write("/zeros", 0, image)
        assert file.stat().st_size < 1 << 20
        assert "a chunk of more than 1048576 bytes" in refusal(file, tmp_path / "store")


def test_other_recordings_are_told_how_to_become_one(tmp_path):
    for name in ("drive.bag", "drive.db3"):
        (tmp_path / name).write_bytes(b"#ROSBAG V2.0")
    with pytest.raises(DataError, match=r"`mcap convert` makes it of a .bag or .db3"):
        ingest_scene("mcap", tmp_path, "drive", tmp_path / "store")


def fuzzed(bag, tmp_path, seeds):
    def damage(rng):
        return bag, damaged_bytes(bag.read_bytes(), rng)

    def ingest(store):
        return ingest_scene("mcap", bag, "ros", store)

    return fuzz(ingest, damage, seeds, sandbox=tmp_path, named=(str(bag), "ros"))


def test_damaged_bags_are_refused_or_sound(bag, tmp_path):
    outcomes = fuzzed(bag, tmp_path, range(100, 112))
    assert outcomes["refused"] > 0


@pytest.mark.slow
def test_two_hundred_damaged_bags(bag, tmp_path):
    outcomes = fuzzed(bag, tmp_path, range(1000, 1200))
    assert outcomes["refused"] + outcomes["accepted"] == 200


RIG = """licence = "own"
world = "map"
ego = "base_link"
[[camera]]
name = "front"
topic = "/front"
lens = "/front/info"
"""


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ('licence = "own"', "", "licence: Field required"),
        ('name = "front"', 'name = "../x"', "camera 0 name: Value error, expected letters"),
        ('lens = "/front/info"', "lens = 7", "camera 0 lens: Input should be a valid string"),
        ("[[camera]]", "[camera]", "camera: Input should be a valid tuple"),
        ('ego = "base_link"', 'ego = "a"\nclock = "sun"', "clock: Input should be 'header' or"),
        ('ego = "base_link"', 'ego = "a"\nego = "b"', "no TOML"),
        ('world = "map"', 'world = "map"\nworlds = 3', "worlds: Extra inputs are not permitted"),
        ('lens = "/front/info"', 'lens = "x"\nlate_s = inf', "late_s: Input should be"),
        (RIG, "licence = 'a'\nworld = 'a'\nego = 'a'\ncamera = []", "camera: Tuple should have"),
        (RIG, RIG + '[[lidar]]\nname = "front"\ntopic = "/b"', "two sensors have the name 'front'"),
        (RIG, RIG + '[[lidar]]\nname = "b"\ntopic = "/front"', "two sensors have the topic"),
    ],
)
def test_senseless_rig(tmp_path, old, new, expected):
    file = tmp_path / "rig.toml"
    file.write_text(RIG.replace(old, new))
    with pytest.raises(ConfigError) as raised:
        read_rig(file)
    assert expected in str(raised.value)
    assert "\n" not in str(raised.value)
    assert str(file) in str(raised.value)


def test_rig_that_is_not_there(tmp_path):
    with pytest.raises(ConfigError, match="cannot be read"):
        read_rig(tmp_path / "rig.toml")
