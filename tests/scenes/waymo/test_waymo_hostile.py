"""A bad Waymo file gets one clear line with file, record and field, and leaves no scene."""

import re
import struct
import zlib

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from waymo_damage import joined, split
from waymo_log import SEGMENT, double, frame_messages, matrix, message, text, tfrecord, whole

from lidarpainter_models.errors import DataError
from lidarpainter_models.scenes.readers import ingest_scene
from lidarpainter_models.scenes.readers.waymo.range_images import MAX_PIXELS, unpack_matrix
from lidarpainter_models.scenes.readers.waymo.tfrecord import (
    MAX_RECORD_BYTES,
    TfrecordFile,
    masked_checksum,
)

CONTEXT, TIME, POSE, IMAGES, LASERS, LABELS = 1, 2, 3, 4, 5, 6
CAMERAS, LIDARS = 2, 3
FILE = f"segment-{SEGMENT}_with_camera_labels.tfrecord"


@pytest.fixture(scope="session")
def messages(tiny_truth):
    return frame_messages(tiny_truth)


@pytest.fixture
def refusal(records, tmp_path):
    """Write records, ingest them, and give the one line they are refused with."""

    def refused(content):
        file = records.root / FILE
        file.write_bytes(content if isinstance(content, bytes) else tfrecord(content))
        return refused_line(records, tmp_path / "store", FILE)

    return refused


def refused_line(folder, store, named):
    with pytest.raises(DataError) as raised:
        folder.ingest(store)
    assert [path for path in store.rglob("*") if path.is_file()] == []
    line = str(raised.value)
    assert "\n" not in line
    assert named in line
    return line


def edited(content, path, change):
    """A message with one field, found by numbers and positions, replaced by what `change` gives.

    `path` is field numbers, each with the position among its equals (`4`, or `(4, 1)`); `change`
    takes the field's value and gives a new one, or None to remove it.
    """
    number, position = path[0] if isinstance(path[0], tuple) else (path[0], 0)
    fields = split(content)
    place = [place for place, field in enumerate(fields) if field[0] == number][position]
    _, kind, value = fields[place]
    new = edited(value, path[1:], change) if path[1:] else change(value)
    fields[place : place + 1] = [] if new is None else [(number, kind, new)]
    return joined(fields)


def with_frame(messages, path, change, index=1):
    """The records with one field of one frame changed."""
    changed = edited(messages[index], path, change)
    return [*messages[:index], changed, *messages[index + 1 :]]


def everywhere(messages, path, change):
    """The records with one field of every frame changed, as for what all of them repeat."""
    return [edited(record, path, change) for record in messages]


# --- framing


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


def test_something_else_entirely(refusal):
    assert "expected a TFRecord file" in refusal(b"GIF89a" + bytes(1000))


# --- messages


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


# --- pictures and cameras


def test_frame_without_pictures(refusal, messages):
    bare = [field for field in split(messages[1]) if field[0] != IMAGES]
    assert "zero pictures, expected at least one" in refusal([messages[0], joined(bare)])


@pytest.mark.parametrize("kept", [0, 2, 100, -2])
def test_truncated_picture(refusal, messages, kept):
    line = refusal(with_frame(messages, [(IMAGES, 1), 2], lambda jpeg: jpeg[:kept]))
    assert "images[1] (SIDE_LEFT): " in line
    assert "JPEG" in line


def test_picture_of_another_size(refusal, messages):
    line = refusal(everywhere(messages, [CONTEXT, CAMERAS, 4], lambda width: width * 2))
    assert "the picture is 32 x 24 px, expected 64 x 24 px as calibrated" in line


def test_picture_of_another_frame(refusal, messages):
    for field in (5, 7, 8):  # pose, trigger and readout, half a second late
        messages = with_frame(messages, [IMAGES, field], lambda value: value + 0.5)
    assert "images[0] (FRONT): taken +0.498 s after the middle of the sweep" in refusal(messages)


def test_picture_whose_pose_is_elsewhere(refusal, messages):
    line = refusal(with_frame(messages, [(IMAGES, 1), 3, (1, 3)], lambda value: value + 4))
    assert "images[1] (SIDE_LEFT), pose: 4." in line


def test_unknown_camera(refusal, messages):
    line = refusal(with_frame(messages, [IMAGES, 1], lambda _: 77))
    assert "images[0]: sensor 77 is not known, expected FRONT, FRONT_LEFT" in line


def test_camera_without_calibration(refusal, messages):
    line = refusal(everywhere(messages, [CONTEXT, (CAMERAS, 1)], lambda _: None))
    assert "images[1] (SIDE_LEFT): the camera has no calibration" in line


@pytest.mark.parametrize(
    ("path", "number", "complaint"),
    [
        ([2, (2, 0)], -1.0, "focal lengths -1 and"),
        ([2, (2, 2)], 1e9, "the principal point is far outside"),
        ([2, (2, 4)], float("nan"), "intrinsic: holds a number that is not finite"),
        ([2, (2, 6)], -9.5, "the distortion of the lens cannot be undone"),
        ([2, (2, 4)], 1e30, "a lens term exceeds 10"),
        ([2, 3, (1, 3)], 400.0, "extrinsic: 400 m from the vehicle"),
        ([2, 3, (1, 0)], 0.3, "extrinsic: the pose is not a rotation"),
    ],
)
def test_senseless_lens(refusal, messages, path, number, complaint):
    line = refusal(everywhere(messages, [CONTEXT, *path], lambda _: number))
    assert "camera_calibrations[0] (FRONT)" in line
    assert complaint in line


def test_picture_as_large_as_a_city(refusal, messages):
    line = refusal(everywhere(messages, [CONTEXT, CAMERAS, 4], lambda _: 65535))
    assert "the picture is 65535 x 24 px, expected 1 to 8192" in line


# --- range images and LiDARs

FIRST, SECOND, RANGES, PIXEL_POSES = 2, 3, 2, 4
SHAPE = message(2, whole(1, 2) + whole(1, 3) + whole(1, 4))


def changed_matrix(change):
    def changed(compressed):
        (_, _, data), (_, _, shape) = split(zlib.decompress(compressed))
        dims = [value for *_, value in split(shape)]
        values = change(np.frombuffer(data, "<f4").reshape(dims).copy())
        return zlib.compress(matrix(values), 1)

    return changed


def fill(place, number):
    def filled(values):
        values[place] = number
        return values

    return filled


@pytest.mark.parametrize(
    ("field", "change", "complaint"),
    [
        ([FIRST, RANGES], fill((3, 4, 0), np.nan), "a range or intensity is not finite"),
        ([FIRST, RANGES], fill((3, 4, 0), 3e30), "a range of 3e+30 m, expected 1000 m at most"),
        ([FIRST, RANGES], lambda image: image[:5], "the echoes differ in shape"),
        ([FIRST, PIXEL_POSES], fill(..., np.nan), "a pixel pose is not finite"),
        ([FIRST, PIXEL_POSES], fill((..., 4), 5e4), "m from the frame's pose, expected 20 m"),
        ([FIRST, PIXEL_POSES], lambda poses: poses[:, :9], "the pixel poses are not one per pixel"),
        ([SECOND, RANGES], lambda image: image[..., :3], "and exactly 4 channels"),
    ],
)
def test_senseless_range_image(refusal, messages, field, change, complaint):
    line = refusal(with_frame(messages, [LASERS, *field], changed_matrix(change)))
    assert "record 1 at byte" in line
    assert "lasers[0] (TOP)" in line
    assert complaint in line


def test_both_echoes_with_too_few_rows(refusal, messages):
    for echo in (FIRST, SECOND):
        change = changed_matrix(lambda image: image[:7])
        messages = with_frame(messages, [LASERS, echo, RANGES], change)
    assert "lasers[0] (TOP): 7 rows, expected 32, one per beam" in refusal(messages)


def test_top_without_pixel_poses(refusal, messages):
    line = refusal(with_frame(messages, [LASERS, FIRST, PIXEL_POSES], lambda _: None))
    assert "lasers[0] (TOP): the pixel poses are missing" in line


def test_frame_without_points(refusal, messages):
    for laser in (0, 1):
        for echo in (FIRST, SECOND):
            path = [(LASERS, laser), echo, RANGES]
            messages = with_frame(messages, path, changed_matrix(fill(..., -1.0)))
    assert "no LiDAR has a point, expected range images" in refusal(messages)


def test_lidar_without_calibration(refusal, messages):
    line = refusal(everywhere(messages, [CONTEXT, (LIDARS, 1)], lambda _: None))
    assert "lasers[1] (REAR): the LiDAR has no calibration" in line


def test_beams_that_do_not_ascend(refusal, messages):
    line = refusal(everywhere(messages, [CONTEXT, LIDARS, (2, 4)], lambda _: 0.2))
    assert "laser_calibrations[0] (TOP): the beam inclinations do not ascend" in line


def test_limits_of_beams_that_are_missing(refusal, messages):
    for field in (3, 4):
        messages = everywhere(messages, [CONTEXT, (LIDARS, 1), field], lambda _: None)
    assert "(REAR): the beam inclinations do not ascend" in refusal(messages)


@pytest.mark.parametrize(
    ("content", "complaint"),
    [
        (b"no zlib", "cannot be unpacked"),
        (zlib.compress(bytes(50_000_000)), "unpacks to more than 8388672 bytes"),
        (zlib.compress(bytes(100))[:-5], "the compressed matrix is cut off"),
        (zlib.compress(b"\xff\xff\xff"), "not a MatrixFloat message"),
        (zlib.compress(b""), "shape \\[\\]"),
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


# --- labels and names


@pytest.mark.parametrize("name", ["../../x", "/etc/passwd", "", "a b", "x\ny", "\u202e", ".."])
def test_actor_that_is_named_for_a_place(refusal, messages, name):
    line = refusal(with_frame(messages, [(LABELS, 2), 4], lambda _: name.encode()))
    assert "laser_labels[2]" in line
    assert "actor name" in line


def test_actor_whose_name_is_no_text(refusal, messages):
    line = refusal(with_frame(messages, [LABELS, 4], lambda _: b"\xff\xfe\x00"))
    assert "laser_labels[0]" in line


@pytest.mark.parametrize(
    ("field", "number", "complaint"),
    [
        ([1, 1], float("nan"), "box: holds a number that is not finite"),
        ([1, 5], -4.0, "box: the box measures -4 x"),
        ([1, 2], 1e12, "box: a box beyond 1000 m"),
        ([3], 9, "label type 9 is not known, expected 0 to 4"),
    ],
)
def test_senseless_label(refusal, messages, field, number, complaint):
    line = refusal(with_frame(messages, [LABELS, *field], lambda _: number))
    assert "laser_labels[0]" in line
    assert complaint in line


def test_label_without_a_box(refusal, messages):
    line = refusal(with_frame(messages, [LABELS, 1], lambda _: None))
    assert "box: the box measures 0 x 0 x 0 m, expected positive sizes" in line


def test_label_that_is_synced_with_no_camera(refusal, messages):
    synced = message(12, double(1, 5.0)) + text(11, "ROOF")
    line = refusal(with_frame(messages, [LABELS], lambda label: label + synced))
    assert "camera_synced_box: sensor 'ROOF' is not known" in line


def test_actor_that_stands_twice_in_a_frame(refusal, messages):
    first = next(field for field in split(messages[1]) if field[0] == LABELS)
    line = refusal([messages[0], messages[1] + joined([first])])
    assert "record 1 at byte" in line
    assert "given twice, expected once a frame" in line


@pytest.mark.parametrize("sequence", ["../x", "..", "/etc", "", "a/b"])
def test_segment_name_that_leaves_the_store(records, tmp_path, sequence):
    with pytest.raises(DataError, match="cannot be used"):
        ingest_scene("waymo", records.root, sequence, tmp_path / "store")


def test_segment_that_is_not_there(records, tmp_path):
    with pytest.raises(DataError, match="no segment other, expected a TFRecord or Parquet file"):
        ingest_scene("waymo", records.root, "other", tmp_path / "store")


def test_cameras_and_frames_that_are_not_there(records, tmp_path):
    with pytest.raises(DataError, match="no camera 'ROOF', expected some of FRONT, FRONT_LEFT"):
        records.ingest(tmp_path / "store", cameras=("ROOF",))
    with pytest.raises(DataError, match="the frames asked for select none of its 2 frames"):
        records.ingest(tmp_path / "store", frames=slice(5, 9))


# --- version 2


def component_refusal(components, store, component, change):
    path = components.root / component / f"{SEGMENT}.parquet"
    pq.write_table(change(pq.read_table(path)), path)
    return refused_line(components, store, f"{component}/{SEGMENT}.parquet")


def with_value(column, row, value):
    def changed(table):
        values = table[column].to_pylist()
        values[row] = value
        kind = table.schema.field(column).type
        place = table.schema.get_field_index(column)
        return table.set_column(place, column, pa.array(values, type=kind))

    return changed


@pytest.mark.parametrize("component", ["lidar_pose", "camera_image", "lidar_box"])
def test_component_that_is_missing(components, tmp_path, component):
    path = components.root / component / f"{SEGMENT}.parquet"
    path.unlink()
    line = refused_line(components, tmp_path / "store", str(path))
    assert line.endswith("the file is missing")


def test_column_that_is_missing(components, tmp_path):
    name = "[LiDARComponent].range_image_return1.shape"
    line = component_refusal(
        components, tmp_path / "store", "lidar", lambda table: table.drop_columns([name])
    )
    assert line.endswith(f"no column {name}")


def test_rows_that_are_not_in_the_order_of_time(components, tmp_path):
    line = component_refusal(
        components,
        tmp_path / "store",
        "camera_image",
        lambda table: table.take(pa.array([0, 2, 1, 3])),
    )
    assert "row 2, key.frame_timestamp_micros: not in the order of time" in line


@pytest.mark.parametrize(
    ("component", "column", "value", "complaint"),
    [
        ("lidar_box", "key.segment_context_name", "../x", "expected '1005081002024129653_5313"),
        ("camera_image", "key.segment_context_name", "other", "row 1, key.segment_context_name"),
        ("camera_image", "[CameraImageComponent].image", None, "row 1, .*image: is empty"),
        ("camera_image", "[CameraImageComponent].image", b"GIF", "not a JPEG picture"),
        ("camera_image", "key.camera_name", 99, "sensor 99 is not known"),
        ("lidar", "key.laser_name", 0, "sensor 0 is not known"),
        ("lidar", "[LiDARComponent].range_image_return1.shape", [9, 9, 9], "expected at most"),
        ("lidar", "[LiDARComponent].range_image_return2.values", [1.0], "4 bytes, expected"),
        ("lidar_pose", "[LiDARPoseComponent].range_image_return1.shape", None, "shape"),
        ("vehicle_pose", "key.frame_timestamp_micros", -5, "expected a time since the epoch"),
        ("lidar_box", "[LiDARBoxComponent].box.heading", float("nan"), "is not finite"),
        ("lidar_box", "key.laser_object_id", "../../x", "actor name"),
        ("camera_calibration", "[CameraCalibrationComponent].width", None, "width: is empty"),
        ("lidar_calibration", "[LiDARCalibrationComponent].beam_inclination.min", 9.0, "ascend|90"),
    ],
)
def test_senseless_value(components, tmp_path, component, column, value, complaint):
    change = with_value(column, 1 if component != "vehicle_pose" else 0, value)
    line = component_refusal(components, tmp_path / "store", component, change)
    assert re.search(complaint, line), line


def test_frame_that_stands_twice(components, tmp_path):
    line = component_refusal(
        components,
        tmp_path / "store",
        "vehicle_pose",
        lambda table: table.take(pa.array([0, 1, 1])),
    )
    assert line.endswith("stands twice, expected once")


def test_file_that_is_no_parquet(components, tmp_path):
    path = components.root / "lidar" / f"{SEGMENT}.parquet"
    path.write_bytes(path.read_bytes()[:-3])
    line = refused_line(components, tmp_path / "store", str(path))
    assert "cannot be read as Parquet" in line


def test_frame_of_countless_rows(components, tmp_path):
    line = component_refusal(
        components,
        tmp_path / "store",
        "camera_image",
        lambda table: table.take(pa.array([0] * 100 + [1, 2, 3])),
    )
    assert "row 64: one row too many, expected 64 a frame at most" in line
