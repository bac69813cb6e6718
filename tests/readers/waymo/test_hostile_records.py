"""A bad record or message of Waymo gets one clear line with file and record."""

import os
import re
import struct

import pytest
from waymo_edits import CONTEXT, FILE, POSE, TIME, edited, joined, refused_line, with_frame
from waymo_records import tfrecord, whole

from lidarpainter_models.readers.waymo.tfrecord import (
    MAX_RECORD_BYTES,
    TfrecordFile,
    masked_checksum,
)


def test_checksum_is_that_of_the_format():
    """The CRC-32C of the digits 1 to 9 is a published check value."""
    turned = (0xE3069283 >> 15) | (0xE3069283 << 17) & 0xFFFFFFFF
    assert masked_checksum(b"123456789") == (turned + 0xA282EAD8) % 2**32


def test_records_come_back(tmp_path):
    file = tmp_path / "x.tfrecord"
    file.write_bytes(tfrecord([b"one", b"", b"three" * 1000]))
    records = TfrecordFile(file)
    assert [records.read(index) for index in range(records.num_records)] == [
        *(b"one", b"", b"three" * 1000)
    ]


def framed_length(num_bytes):
    length = struct.pack("<Q", num_bytes)
    return length + struct.pack("<I", masked_checksum(length))


@pytest.mark.parametrize("num_bytes", [MAX_RECORD_BYTES + 1, 2**32, 2**63, 2**64 - 1])
def test_length_that_no_frame_has(refusal, num_bytes):
    line = refusal(framed_length(num_bytes) + b"content")
    assert f"record 0 at byte 0: states {num_bytes} bytes, expected" in line


def test_length_beyond_the_file(refusal, messages):
    line = refusal(tfrecord(messages) + framed_length(1000) + b"only this")
    assert "record 2 at byte" in line
    assert "states 1000 bytes, the file ends after 9" in line


@pytest.mark.parametrize("kept", [1, 8, 11])
def test_file_that_ends_inside_a_length(refusal, messages, kept):
    line = refusal(tfrecord(messages) + framed_length(1000)[:kept])
    assert "the file ends inside the length of a record" in line


def test_flipped_bit_in_a_length(refusal, messages):
    content = bytearray(tfrecord(messages))
    content[0] ^= 1
    assert "record 0 at byte 0: the checksum of the length differs" in refusal(bytes(content))


def test_flipped_bit_in_a_frame(refusal, messages):
    content = bytearray(tfrecord(messages))
    content[-100] ^= 4
    line = refusal(bytes(content))
    assert "record 1 at byte" in line
    assert f"the checksum of its {len(messages[1])} bytes differs" in line


def test_file_without_a_record(refusal):
    assert refusal(b"").endswith("zero records, expected at least one")


def test_pipe_in_place_of_records(records, tmp_path):
    path = records.root / FILE
    path.unlink()
    os.mkfifo(path)
    assert refused_line(records, tmp_path / "store", FILE).endswith(f"{FILE}: not a file")


def test_something_else_entirely(refusal):
    assert "expected a TFRecord file" in refusal(b"GIF89a" + bytes(1000))


def test_message_that_nests_without_end(refusal, messages):
    groups = joined([(20, 3, 100_000)])
    line = refusal([messages[0], messages[1] + groups])
    assert "record 1 at byte" in line
    assert "not a Frame message" in line


def test_millions_of_tiny_messages_are_counted_before_they_are_made(refusal, messages):
    many = b"\x32\x00" * (1 << 20)
    assert f"{(1 << 20) + 12} labels, expected" in refusal([messages[0] + many])
    many = b"\x2a\x00" * (1 << 20)
    assert "lasers: " in refusal([messages[0] + many])


def test_field_of_another_type(refusal, messages):
    """A pose as a number is an unknown field to the parser, so the pose is missing."""
    wrong = edited(messages[0], [POSE], lambda _: None) + whole(POSE, 7)
    assert "pose: has 0 numbers, expected 16" in refusal([wrong])


def test_empty_record(refusal):
    assert "record 0 at byte 0, timestamp: 0 us, expected a time" in refusal([b""])


@pytest.mark.parametrize("number", [float("nan"), float("inf")])
def test_pose_that_is_not_finite(refusal, messages, number):
    line = refusal(with_frame(messages, [POSE, (1, 3)], lambda _: number))
    assert "record 1 at byte" in line
    assert "pose: holds a number that is not finite" in line


def test_pose_that_is_no_rotation(refusal, messages):
    line = refusal(with_frame(messages, [POSE, (1, 0)], lambda value: 3 * value + 1))
    assert "pose: the pose is not a rotation and a translation" in line


def test_pose_that_jumps(refusal, messages):
    line = refusal(with_frame(messages, [POSE, (1, 3)], lambda value: value + 30))
    assert re.search(r"the vehicle has moved (29|30)\.\d m", line)


def test_frames_out_of_order(refusal, messages):
    assert "expected more than the frame before" in refusal(messages[::-1])


@pytest.mark.parametrize("time_us", [0, 2**63 - 1])
def test_time_that_is_none(refusal, messages, time_us):
    line = refusal(with_frame(messages, [TIME], lambda _: time_us, index=0))
    assert f"timestamp: {time_us} us, expected a time since the epoch" in line


def test_frame_of_another_segment(refusal, messages):
    line = refusal(with_frame(messages, [CONTEXT, 1], lambda _: b"another"))
    assert "context: segment b'another', expected" in line
