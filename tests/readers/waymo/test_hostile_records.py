"""A bad record, message, image or range image of Waymo gets one line with file and record."""

import os
import struct
import zlib

import numpy as np
import pytest
from waymo_edits import (
    CAMERAS,
    CONTEXT,
    FILE,
    IMAGES,
    LABELS,
    LASERS,
    LIDARS,
    POSE,
    TIME,
    everywhere,
    joined,
    refused_line,
    split,
    with_frame,
)
from waymo_records import matrix, message, tfrecord, whole

from lidarpainter_models.errors import DataError
from lidarpainter_models.readers.waymo.range_images import MAX_PIXELS, unpack_matrix
from lidarpainter_models.readers.waymo.tfrecord import (
    MAX_RECORD_BYTES,
    TfrecordFile,
    masked_checksum,
)
from lidarpainter_models.scenes.driving_scene import DrivingScene

FIRST, SECOND, RANGES, PIXEL_POSES = 2, 3, 2, 4
SHAPE = message(2, whole(1, 2) + whole(1, 3) + whole(1, 4))
NAN = float("nan")


def test_checksum_is_that_of_the_format():
    """The CRC-32C of the digits 1 to 9 is a published check value."""
    turned = (0xE3069283 >> 15) | (0xE3069283 << 17) & 0xFFFFFFFF
    assert masked_checksum(b"123456789") == (turned + 0xA282EAD8) % 2**32


def test_records_come_back(tmp_path):
    file = tmp_path / "x.tfrecord"
    written = [b"one", b"", b"three" * 1000]
    file.write_bytes(tfrecord(written))
    records = TfrecordFile(file)
    assert [records.read(index) for index in range(records.num_records)] == written


def framed_length(num_bytes):
    length = struct.pack("<Q", num_bytes)
    return length + struct.pack("<I", masked_checksum(length))


def flipped(content, place):
    content = bytearray(content)
    content[place] ^= 1
    return bytes(content)


@pytest.mark.parametrize(
    ("damage", "complaint"),
    [
        (lambda _: b"", "zero records, expected at least one"),
        (lambda _: b"GIF89a" + bytes(1000), "expected a TFRecord file"),
        (lambda _: framed_length(MAX_RECORD_BYTES + 1), "record 0 at byte 0: states"),
        (lambda _: framed_length(2**64 - 1), "record 0 at byte 0: states"),
        (lambda c: c + framed_length(1000) + b"only", "states 1000 bytes, the file ends after 4"),
        (lambda c: c + framed_length(9)[:8], "the file ends inside the length of a record"),
        (lambda c: flipped(c, 0), "record 0 at byte 0: the checksum of the length differs"),
        (lambda c: flipped(c, -100), "bytes differs"),
    ],
)
def test_file_that_holds_no_whole_records(refusal, messages, damage, complaint):
    assert complaint in refusal(damage(tfrecord(messages)))


def test_pipe_in_place_of_records(records, tmp_path):
    path = records.root / FILE
    path.unlink()
    os.mkfifo(path)
    assert refused_line(records, tmp_path / "store", FILE).endswith(f"{FILE}: not a file")


@pytest.mark.parametrize(
    ("added", "complaint"),
    [
        (joined([(20, 3, 100_000)]), "not a Frame message"),  # groups within groups
        (b"\x32\x00" * (1 << 20), f"{(1 << 20) + 12} labels, expected"),
        (b"\x2a\x00" * (1 << 20), "lasers: "),
    ],
)
def test_message_of_too_much_is_refused_before_it_is_made(refusal, messages, added, complaint):
    assert complaint in refusal([messages[0] + added])


def test_frames_out_of_order(refusal, messages):
    assert "expected more than the frame before" in refusal(messages[::-1])


def becomes(value):
    return lambda _: value


def changed_matrix(change):
    def changed(compressed):
        (*_, data), (*_, shape) = split(zlib.decompress(compressed))
        values = np.frombuffer(data, "<f4").reshape([value for *_, value in split(shape)])
        return zlib.compress(matrix(change(values.copy())), 1)

    return changed


def fill(place, number):
    def filled(values):
        values[place] = number
        return values

    return filled


ECHO, POSES = [LASERS, FIRST, RANGES], [LASERS, FIRST, PIXEL_POSES]


@pytest.mark.parametrize(
    ("path", "change", "complaint"),
    [
        ([POSE, (1, 3)], becomes(NAN), "pose: holds a number that is not finite"),
        ([POSE, (1, 0)], lambda value: 3 * value + 1, "not a rotation and a translation"),
        ([POSE, (1, 3)], lambda value: value + 30, "the vehicle has moved"),
        ([POSE], becomes(None), "pose: has 0 numbers, expected 16"),
        ([TIME], becomes(2**63 - 1), "us, expected a time since the epoch"),
        ([CONTEXT, 1], becomes(b"another"), "context: segment b'another', expected"),
        ([LABELS, 4], becomes(b"../../x"), "actor name '../../x'"),
        ([LABELS, 4], becomes(b"\xff\xfe\x00"), "laser_labels[0]"),
        ([LABELS, 1, 1], becomes(NAN), "box: holds a number that is not finite"),
        ([LABELS, 1, 5], becomes(-4.0), "box: the box measures -4 x"),
        ([LABELS, 3], becomes(9), "label type 9 is not known, expected 0 to 4"),
        ([IMAGES, 1], becomes(77), "images[0]: sensor 77 is not known, expected FRONT"),
        ([(IMAGES, 1), 3, (1, 3)], lambda value: value + 4, "images[1] (SIDE_LEFT), pose: 4."),
        ([IMAGES, 4, 1], becomes(1e30), "velocity: faster than 100 m/s or"),
        (ECHO, changed_matrix(fill((3, 4, 0), np.nan)), "a range or intensity is not finite"),
        (ECHO, changed_matrix(fill((3, 4, 0), 3e30)), "3e+30 m, expected 1000 m at most"),
        (ECHO, changed_matrix(lambda image: image[:5]), "the echoes differ in shape"),
        (ECHO, changed_matrix(fill(..., -1.0)), "later echoes have no earlier one"),
        (ECHO, becomes(None), "a range image of the second echo, but none of the first"),
        (POSES, changed_matrix(fill((..., 4), 5e4)), "m from the frame's pose, expected 20 m"),
        (POSES, changed_matrix(lambda poses: poses[:, :9]), "are not one per pixel"),
        (POSES, becomes(None), "lasers[0] (TOP): the pixel poses are missing"),
    ],
)
def test_senseless_frame(refusal, messages, path, change, complaint):
    line = refusal(with_frame(messages, path, change))
    assert "record 1 at byte" in line
    assert complaint in line


@pytest.mark.parametrize(
    ("path", "change", "complaint"),
    [
        ([CAMERAS, 4], becomes(64), "the image is 32 x 24 px, expected 64 x 24 px as calibrated"),
        ([CAMERAS, 4], becomes(65535), "the image is 65535 x 24 px, expected 1 to 8192"),
        ([CAMERAS, (2, 0)], becomes(-1.0), "(FRONT): focal lengths -1 and"),
        ([CAMERAS, (2, 6)], becomes(-9.5), "the distortion of the lens cannot be undone"),
        ([CAMERAS, 3, (1, 3)], becomes(400.0), "(FRONT), extrinsic: 400 m from the vehicle"),
        ([(CAMERAS, 1)], becomes(None), "images[1] (SIDE_LEFT): the camera has no calibration"),
        ([(LIDARS, 1)], becomes(None), "lasers[1] (REAR): the LiDAR has no calibration"),
        ([LIDARS, (2, 4)], becomes(0.2), "(TOP): the beam inclinations do not ascend"),
    ],
)
def test_senseless_calibration(refusal, messages, path, change, complaint):
    assert complaint in refusal(everywhere(messages, [CONTEXT, *path], change))


def test_frame_that_lacks_the_image_of_a_camera(refusal, messages, records, tmp_path):
    line = refusal(with_frame(messages, [(IMAGES, 1)], lambda _: None))
    assert "record 1 at byte" in line
    expected = "no image of SIDE_LEFT, expected one of each camera; to read the others alone: "
    assert line.endswith(f"{expected}--cameras FRONT")
    scene = DrivingScene.open(records.ingest(tmp_path / "store", cameras=("FRONT",)))
    assert (scene.camera_names, len(scene.views)) == (("FRONT",), 2)


@pytest.mark.parametrize("lasers", [(0,), (0, 1)])
def test_frame_without_points(refusal, messages, lasers):
    for laser in lasers:
        for echo in (FIRST, SECOND):
            path = [(LASERS, laser), echo, RANGES]
            messages = with_frame(messages, path, changed_matrix(fill(..., -1.0)))
    who = "the TOP LiDAR has no point" if lasers == (0,) else "no LiDAR has a point"
    assert f"{who}, expected" in refusal(messages)


@pytest.mark.parametrize(
    ("content", "complaint"),
    [
        (b"no zlib", "cannot be unpacked"),
        (zlib.compress(bytes(50_000_000)), "unpacks to more than 8388672 bytes"),
        (zlib.compress(bytes(100))[:-5], "the compressed matrix is cut off"),
        (zlib.compress(b"\xff\xff\xff"), "not a MatrixFloat message"),
        (zlib.compress(message(2, whole(1, 2**31 - 1) * 3)), "shape \\[2147483647"),
        (zlib.compress(message(1, bytes(40)) + SHAPE), "40 bytes, expected 96 for shape"),
    ],
)
def test_matrix_that_is_none(content, complaint):
    with pytest.raises(DataError, match=f"^here: .*{complaint}"):
        unpack_matrix(content, 4, "here")


def test_matrix_within_the_limits_of_each_side_but_not_of_both():
    assert MAX_PIXELS < 256 * 8192
    dims = message(2, whole(1, 256) + whole(1, 8192) + whole(1, 4))
    with pytest.raises(DataError, match="at most 256 rows, 8192 columns, 524288 pixels"):
        unpack_matrix(zlib.compress(message(1, bytes(16)) + dims), 4, "here")
