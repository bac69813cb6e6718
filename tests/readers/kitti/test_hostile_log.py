"""A bad KITTI drive gets one clear line with its file, and leaves nothing behind."""

import numpy as np
import pytest
from kitti_log import DRIVE
from written_logs import WRITERS

RAW, TRACKING = "kitti, raw", "kitti, tracking"
OXTS, SWEEP = f"{DRIVE}/oxts/data/0000000001.txt", f"{DRIVE}/velodyne_points/data/0000000001.bin"
TIMES, BOXES = f"{DRIVE}/oxts/timestamps.txt", f"{DRIVE}/tracklet_labels.xml"
IMAGE, LABELS = f"{DRIVE}/image_02/data/0000000001.png", "label_02/0007.txt"
CALIB = "training/calib/0007.txt"


@pytest.fixture(scope="module")
def sound(tmp_path_factory):
    return {name: WRITERS[name](tmp_path_factory.mktemp("log")) for name in (RAW, TRACKING)}


def replaced(old, new):
    return lambda content: content.replace(old, new, 1)


def nan_point(content):
    scan = np.frombuffer(content, "<f4").copy()
    scan[4 * 7] = np.nan
    return scan.tobytes()


CASES = [
    (RAW, OXTS, lambda _: b"", "packet 1: expected 30 numbers"),
    (RAW, OXTS, lambda _: b"nan 8 116 0 0 0", "packet 1: nowhere on Earth"),
    (RAW, OXTS, lambda _: b"49 9 116 0 0 0", "from its LiDAR, expected 1000 m"),
    (RAW, TIMES, lambda _: b"", "no time, expected one for every frame"),
    (RAW, TIMES, lambda _: b"soon", "line 0: 'soon', expected a time as"),
    (RAW, SWEEP, lambda content: content[:-3], "expected whole points of 16"),
    (RAW, SWEEP, nan_point, "point 7: holds something other than finite numbers"),
    (RAW, IMAGE, lambda _: b"GIF89a", "neither a JPEG nor a PNG image"),
    (RAW, IMAGE, replaced(b"\x00\x00\x00\x60", b"\x7f\xff\xff\xff"), "expected at most 64 million"),
    (RAW, BOXES, lambda content: content[:-9], "no XML"),
    (RAW, BOXES, lambda _: b"<!DOCTYPE a [<!ENTITY b 'c'>]><a/>", "declares entities"),
    (RAW, BOXES, replaced(b"<tx>", b"<tx>x"), "expected finite numbers tx, ty, tz, rz"),
    (RAW, "calib_velo_to_cam.txt", replaced(b"R:", b"R: 7"), "R: 10 numbers, expected 9 finite"),
    (RAW, "calib_cam_to_cam.txt", replaced(b"P_rect_03", b"Q"), "no row P_rect_03"),
    (TRACKING, CALIB, replaced(b"P2 ", b"P2 -"), "P2: no projection of a camera"),
    (TRACKING, LABELS, lambda _: b"0 ../x Car" + b" 1" * 14, "words of a label"),
]


@pytest.mark.parametrize(("name", "pattern", "change", "expected"), CASES)
def test_senseless_file(sound, tmp_path, name, pattern, change, expected):
    log = sound[name].copied(tmp_path / "log")
    file = next(log.root.glob(f"**/{pattern}"))
    file.write_bytes(change(file.read_bytes()))
    assert expected in log.refusal(tmp_path / "store")
