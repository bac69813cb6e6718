"""Write a `WaymoTruth` as version 1 of the Waymo Open Dataset would hold it: a TFRecord file.

The protobuf messages are put together byte by byte from the field numbers of `dataset.proto` and
`label.proto`, not through the reader's own schema: what both have wrong together would not show.
"""

import struct
import zlib

import google_crc32c
from waymo_numbers import (
    CAMERA_NUMBERS,
    LIDAR_NUMBERS,
    SEGMENT,
    camera_numbers,
    frame_numbers,
    lidar_numbers,
)


def tfrecord(records):
    """Records with their lengths and checksums."""
    return b"".join(_framed(record) for record in records)


def write_v1(truth, folder, segment=SEGMENT):
    """One TFRecord file with every frame of the truth; gives its path."""
    path = folder / f"segment-{segment}_with_camera_labels.tfrecord"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(tfrecord(frame_messages(truth, segment)))
    return path


def frame_messages(truth, segment=SEGMENT):
    """The frames as `Frame` messages."""
    context = context_message(truth, segment)
    return [
        frame_message(frame_numbers(truth, index), context) for index in truth.scene.frame_indices
    ]


def context_message(truth, segment):
    """Name and calibrations, which every frame repeats."""
    cameras = [camera_numbers(truth, name) for name in truth.scene.camera_names]
    lidars = [lidar_numbers(truth, name) for name in truth.scene.lidar_names]
    calibrations = [message(2, camera_message(camera)) for camera in cameras]
    calibrations += [message(3, lidar_message(lidar)) for lidar in lidars]
    return b"".join([text(1, segment), *calibrations])


def camera_message(camera):
    return b"".join(
        [
            whole(1, CAMERA_NUMBERS[camera["name"]]),
            *[double(2, number) for number in camera["intrinsic"]],
            message(3, transform(camera["extrinsic"])),
            whole(4, camera["width"]),
            whole(5, camera["height"]),
            whole(6, camera["readout"]),
        ]
    )


def lidar_message(lidar):
    return b"".join(
        [
            whole(1, LIDAR_NUMBERS[lidar["name"]]),
            *[double(2, number) for number in lidar["beams"]],
            double(3, lidar["limits"][0]),
            double(4, lidar["limits"][1]),
            message(5, transform(lidar["extrinsic"])),
        ]
    )


def frame_message(frame, context):
    return b"".join(
        [
            message(1, context),
            whole(2, frame.start_us),
            message(3, transform(frame.pose)),
            *[message(4, image_message(image)) for image in frame.images],
            *[message(5, laser_message(laser)) for laser in frame.lasers],
            *[message(6, label_message(label)) for label in frame.labels],
            message(7, double(1, 3.5) + text(3, "a no-label zone, which nobody reads")),
        ]
    )


def image_message(image):
    linear, angular = image["velocity"][:3], image["velocity"][3:]
    velocity = [single(number, value) for number, value in enumerate(linear, start=1)]
    velocity += [double(number, value) for number, value in enumerate(angular, start=4)]
    return b"".join(
        [
            whole(1, CAMERA_NUMBERS[image["name"]]),
            message(2, image["jpeg"]),
            message(3, transform(image["pose"])),
            message(4, b"".join(velocity)),
            double(5, image["pose_time"]),
            double(6, image["shutter"]),
            double(7, image["trigger"]),
            double(8, image["done"]),
        ]
    )


def laser_message(laser):
    first, second = (message(2, zlib.compress(matrix(image), 1)) for image in laser["returns"])
    if laser["poses"] is not None:
        first += message(4, zlib.compress(matrix(laser["poses"]), 1))
    return whole(1, LIDAR_NUMBERS[laser["name"]]) + message(2, first) + message(3, second)


def label_message(label):
    parts = [
        message(1, box_message(label["box"])),
        message(2, double(1, label["speed"][0]) + double(2, label["speed"][1])),
        whole(3, label["type"]),
        text(4, label["id"]),
    ]
    if label["synced"] is not None:
        parts += [text(11, label["synced"][0]), message(12, box_message(label["synced"][1]))]
    return b"".join(parts)


def box_message(numbers):
    x, y, z, length, width, height, heading = numbers
    fields = ((1, x), (2, y), (3, z), (5, length), (4, width), (6, height), (7, heading))
    return b"".join(double(number, value) for number, value in fields)


def matrix(values):
    """A `MatrixFloat`: packed numbers, then the shape."""
    dims = b"".join(whole(1, size) for size in values.shape)
    return message(1, values.astype("<f4").tobytes()) + message(2, dims)


def transform(numbers):
    return b"".join(double(1, number) for number in numbers)


def whole(number, value):
    return varint(number << 3) + varint(value)


def double(number, value):
    return varint(number << 3 | 1) + struct.pack("<d", value)


def single(number, value):
    return varint(number << 3 | 5) + struct.pack("<f", value)


def text(number, value):
    return message(number, value.encode())


def message(number, content):
    return varint(number << 3 | 2) + varint(len(content)) + content


def varint(value):
    content = bytearray()
    while value > 0x7F:
        content.append(value & 0x7F | 0x80)
        value >>= 7
    content.append(value)
    return bytes(content)


def _framed(content):
    length = struct.pack("<Q", len(content))
    return length + _checksum(length) + content + _checksum(content)


def _checksum(content):
    checksum = google_crc32c.value(content)
    turned = (checksum >> 15 | checksum << 17) & 0xFFFFFFFF
    return struct.pack("<I", (turned + 0xA282EAD8) & 0xFFFFFFFF)
