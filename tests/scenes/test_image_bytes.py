"""Stored images are decoded as they lie in the file, whatever their EXIF tag asks of a viewer."""

import re
import struct
from pathlib import Path

import cv2
import numpy as np
import pytest
from splat_drawing import pinhole

import lidarpainter_models
from lidarpainter_models.export.images import read_image
from lidarpainter_models.scenes.image_bytes import can_decode, decode_image
from lidarpainter_models.scenes.records import ImageRecord
from lidarpainter_models.stress.frames import Shot

QUARTER_TURN = 6


def turned_by_viewers(bgr):
    """A JPEG whose EXIF tag asks for a quarter turn."""
    jpeg = cv2.imencode(".jpg", bgr)[1].tobytes()
    entry = struct.pack("<HHII", 0x0112, 3, 1, QUARTER_TURN)
    tags = b"Exif\0\0II*\0" + struct.pack("<IH", 8, 1) + entry + struct.pack("<I", 0)
    return jpeg[:2] + b"\xff\xe1" + struct.pack(">H", len(tags) + 2) + tags + jpeg[2:]


@pytest.fixture
def jpeg():
    bgr = np.zeros((24, 48, 3), np.uint8)
    bgr[:, :16] = 255
    encoded = turned_by_viewers(bgr)
    shown = cv2.imdecode(np.frombuffer(encoded, np.uint8), cv2.IMREAD_COLOR)
    assert shown.shape == (48, 24, 3)  # what ignoring the tag is tested against
    return encoded


def lies_as_stored(bgr):
    return bgr.shape == (24, 48, 3) and bgr[:, :12].mean() > 250 and bgr[:, 20:].mean() < 5


def test_a_tag_that_asks_for_a_turn_is_ignored(jpeg, tmp_path):
    assert lies_as_stored(decode_image(jpeg))
    path = tmp_path / "tagged.jpg"
    path.write_bytes(jpeg)
    assert lies_as_stored((read_image(path) * 255).numpy())


def test_a_spoilt_image_keeps_its_way_up(jpeg):
    camera = pinhole(fx_px=48.0, fy_px=48.0, cx_px=24.0, cy_px=12.0, width_px=48, height_px=24)
    record = ImageRecord(camera_name="front", timestamp_ns=0, camera=camera)
    spoilt = Shot(record=record, jpeg=jpeg, source="").with_pixels(lambda bgr: bgr)
    assert lies_as_stored(decode_image(spoilt.jpeg))


@pytest.mark.parametrize("encoded", [b"", b"no image"])
def test_what_is_no_image_gives_none(encoded):
    assert decode_image(encoded) is None
    assert not can_decode(encoded)


def test_images_of_logs_are_decoded_in_one_place_and_textures_in_another():
    root = Path(lidarpainter_models.__file__).parent
    decoding = re.compile(r"cv2\.(imread|imdecode)\w*\(|Image\.open\(")
    places = [
        str(path.relative_to(root))
        for path in root.rglob("*.py")
        if decoding.search(path.read_text("utf-8"))
    ]
    assert sorted(places) == ["assets/foreign_images.py", "scenes/image_bytes.py"]
