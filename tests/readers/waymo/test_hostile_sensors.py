"""A bad image, camera, range image or LiDAR of Waymo gets one line with its field."""

import zlib

import numpy as np
import pytest
from waymo_edits import (
    CAMERAS,
    CONTEXT,
    IMAGES,
    LASERS,
    LIDARS,
    everywhere,
    joined,
    split,
    with_frame,
)
from waymo_records import matrix, message, whole

from lidarpainter_models.errors import DataError
from lidarpainter_models.readers.waymo.range_images import MAX_PIXELS, unpack_matrix
from lidarpainter_models.scenes.driving_scene import DrivingScene


def test_frame_without_images(refusal, messages):
    bare = [field for field in split(messages[1]) if field[0] != IMAGES]
    assert "zero images, expected at least one" in refusal([messages[0], joined(bare)])


def test_frame_that_lacks_the_image_of_a_camera(refusal, messages, records, tmp_path):
    lacking = with_frame(messages, [(IMAGES, 1)], lambda _: None)
    line = refusal(lacking)
    assert "record 1 at byte" in line
    expected = "no image of SIDE_LEFT, expected one of each camera; to read the others alone: "
    assert line.endswith(f"{expected}--cameras FRONT")
    scene = DrivingScene.open(records.ingest(tmp_path / "store", cameras=("FRONT",)))
    assert (scene.camera_names, len(scene.views)) == (("FRONT",), 2)


def test_camera_asked_for_that_no_frame_has(records, tmp_path):
    with pytest.raises(DataError, match="no image of SIDE_RIGHT, expected one of each camera"):
        records.ingest(tmp_path / "store", cameras=("FRONT", "SIDE_RIGHT"))


def test_image_of_another_size(refusal, messages):
    line = refusal(everywhere(messages, [CONTEXT, CAMERAS, 4], lambda width: width * 2))
    assert "the image is 32 x 24 px, expected 64 x 24 px as calibrated" in line


def test_image_of_another_frame(refusal, messages):
    for field in (5, 7, 8):  # pose, trigger and readout, half a second late
        messages = with_frame(messages, [IMAGES, field], lambda value: value + 0.5)
    assert "images[0] (FRONT): taken +0.498 s after the middle of the sweep" in refusal(messages)


def test_image_whose_pose_is_elsewhere(refusal, messages):
    line = refusal(with_frame(messages, [(IMAGES, 1), 3, (1, 3)], lambda value: value + 4))
    assert "images[1] (SIDE_LEFT), pose: 4." in line


@pytest.mark.parametrize(
    ("field", "number"), [(1, 1e30), (3, -200.0), (4, 1e200), (5, 1e308), (6, -20.0)]
)
def test_image_taken_at_no_speed_of_a_car(refusal, messages, field, number):
    line = refusal(with_frame(messages, [IMAGES, 4, field], lambda _: number))
    assert "images[0] (FRONT), velocity: faster than 100 m/s or" in line


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


def test_image_as_large_as_a_city(refusal, messages):
    line = refusal(everywhere(messages, [CONTEXT, CAMERAS, 4], lambda _: 65535))
    assert "the image is 65535 x 24 px, expected 1 to 8192" in line


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


def test_frame_without_its_top_lidar(refusal, messages):
    for echo in (FIRST, SECOND):
        messages = with_frame(
            messages, [(LASERS, 0), echo, RANGES], changed_matrix(fill(..., -1.0))
        )
    assert "the TOP LiDAR has no point, expected its range images" in refusal(messages)


def test_second_echoes_without_first_ones(refusal, messages):
    change = changed_matrix(fill(..., -1.0))
    line = refusal(with_frame(messages, [(LASERS, 0), FIRST, RANGES], change))
    assert "later echoes have no earlier one" in line


def test_range_image_of_a_second_echo_alone(refusal, messages):
    line = refusal(with_frame(messages, [(LASERS, 0), FIRST, RANGES], lambda _: None))
    assert "lasers[0] (TOP): a range image of the second echo, but none of the first" in line


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
