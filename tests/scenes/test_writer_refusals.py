"""The writer refuses what makes no scene, in one line with its place."""

import math
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
from scene_parts import (
    HEADER,
    IDENTITY,
    add_frame,
    add_sweep,
    files_below,
    some_box,
    some_jpeg,
    some_points,
    some_record,
)

from lidarpainter_models.checks.doctor import check_scene
from lidarpainter_models.checks.overlay import draw_overlay
from lidarpainter_models.errors import DataError, SceneError
from lidarpainter_models.geometry.transforms import rigid_from_tangent
from lidarpainter_models.scenes.driving_scene import DrivingScene
from lidarpainter_models.scenes.records import Distortion, SweepPoints
from lidarpainter_models.scenes.validation import require_jpeg
from lidarpainter_models.scenes.writer import SceneWriter


def add_frame_with_boxes(writer, boxes):
    add_frame(writer)
    writer.add_boxes(boxes)


@pytest.mark.parametrize("position", [0, 3])
def test_one_senseless_box_among_many_is_named(tmp_path, position):
    boxes = [some_box(actor_id=f"car-{number}") for number in range(5)]
    boxes[position] = replace(boxes[position], world_from_box=2 * IDENTITY)
    with (
        pytest.raises(DataError, match=f"actor car-{position}: the pose is not a rotation"),
        SceneWriter(tmp_path, "rig", "a", HEADER) as writer,
    ):
        add_frame_with_boxes(writer, boxes)


@pytest.mark.parametrize("category", ["", "a\nb", "\ud800", "x" * 201])
def test_category_that_is_no_printable_text_is_refused(tmp_path, category):
    with (
        pytest.raises(DataError, match="expected a printable text"),
        SceneWriter(tmp_path, "rig", "a", HEADER) as writer,
    ):
        add_frame_with_boxes(writer, [some_box(category=category)])


@pytest.mark.parametrize("name", ["../x", "a/b", "", ".hidden", "a b", "ü", "a\n"])
@pytest.mark.parametrize("position", [0, 1])
def test_name_that_is_no_plain_folder_is_refused(tmp_path, name, position):
    names = ["rig", "a"]
    names[position] = name
    with pytest.raises(DataError, match="cannot be used: expected at most 128 letters"):
        SceneWriter(tmp_path, *names, HEADER)
    assert files_below(tmp_path) == []


@pytest.mark.parametrize("missing", ["frames", "images"])
def test_scene_without_frames_or_images_is_refused(tmp_path, missing):
    def write(writer):
        if missing == "images":
            writer.add_frame(0, timestamp_ns=0, world_from_ego=IDENTITY)
            add_sweep(writer, some_points())

    with (
        pytest.raises(DataError, match=f"rig/a: zero {missing}, expected at least one"),
        SceneWriter(tmp_path, "rig", "a", HEADER) as writer,
    ):
        write(writer)
    assert files_below(tmp_path) == []


def test_more_lidars_than_a_byte_counts_are_refused(tmp_path):
    place = {"timestamp_ns": 7, "world_from_lidar": IDENTITY}
    with SceneWriter(tmp_path, "rig", "a", HEADER) as writer:
        add_frame(writer)  # has one of its own
        for number in range(1, 256):
            writer.add_sweep(f"roof-{number}", some_points(1), **place)
        with pytest.raises(DataError, match="lidar roof-256: one LiDAR too many, expected 256"):
            writer.add_sweep("roof-256", some_points(1), **place)


def test_scene_without_lidar_is_read_back_and_examined(tmp_path):
    with SceneWriter(tmp_path, "rig", "a", HEADER) as writer:
        for frame in range(2):
            writer.add_frame(frame, timestamp_ns=frame, world_from_ego=IDENTITY)
            writer.add_image(replace(some_record(), timestamp_ns=frame), some_jpeg())
    scene = DrivingScene.open(writer.path)
    assert (scene.lidar_names, scene.sweeps, scene.has_lidar({0, 1})) == ((), (), False)
    found = {check.name: check for check in check_scene(scene)}
    assert found["LiDAR"].verdict == "warn"
    assert [check for check in found.values() if check.verdict == "fail"] == []
    assert not {"ground", "sweeps agree", "boxes hold points"} & found.keys()
    assert draw_overlay(scene, scene.views[0]).shape[2] == 3


def ego_pose(degrees, axis, place_m=(0.0, 0.0, 0.0)):
    tangent = torch.zeros(6, dtype=torch.float64)
    tangent[axis] = math.radians(degrees)
    pose = rigid_from_tangent(tangent)
    pose[:3, 3] = torch.tensor(place_m, dtype=torch.float64)
    return pose


@pytest.mark.parametrize(
    ("pose", "complaint"),
    [
        (ego_pose(0, 2, (3e4, 0, 0)), "ego pose is 30000 m from the world's origin, expected"),
        (ego_pose(90, 0), "ego's z axis leans 90 degrees from the world's, expected both to point"),
        (ego_pose(180, 1), "ego's z axis leans 180 degrees from the world's"),
    ],
)
def test_world_far_from_its_first_pose_or_without_z_up_is_refused(tmp_path, pose, complaint):
    with (
        pytest.raises(DataError, match=f"rig/a, frame 0, ego: the (first )?{complaint}"),
        SceneWriter(tmp_path, "rig", "a", HEADER) as writer,
    ):
        writer.add_frame(0, timestamp_ns=0, world_from_ego=pose)
    assert files_below(tmp_path) == []


def test_world_of_any_level_axes_is_taken_and_a_drive_may_lead_far(tmp_path):
    with SceneWriter(tmp_path, "rig", "a", HEADER) as writer:
        add_frame(writer)
        writer.add_frame(1, timestamp_ns=100, world_from_ego=ego_pose(0, 2, (3e4, 0, 0)))
    with SceneWriter(tmp_path, "rig", "east-north", HEADER) as writer:
        north = ego_pose(90, 2, (900.0, -900.0, 100.0))
        writer.add_frame(0, timestamp_ns=0, world_from_ego=north @ ego_pose(15, 1))
        writer.add_image(some_record(), some_jpeg())
        add_sweep(writer, some_points())
    assert writer.path.is_dir()


def test_png_is_refused_with_what_was_expected():
    png = cv2.imencode(".png", np.zeros((24, 32, 3), np.uint8))[1].tobytes()
    with pytest.raises(DataError, match="front/3: a PNG image, expected JPEG: convert it"):
        require_jpeg(png, width_px=32, height_px=24, where="front/3")


def bad_poses():
    stretched = IDENTITY.clone()
    stretched[0, 0] = 2
    mirrored = IDENTITY.clone()
    mirrored[2, 2] = -1
    return {"nan": IDENTITY * torch.nan, "stretched": stretched, "mirrored": mirrored}


BAD_THINGS = {
    **{
        f"{name} ego pose": lambda writer, pose=pose: writer.add_frame(
            1, timestamp_ns=999, world_from_ego=pose
        )
        for name, pose in bad_poses().items()
    },
    "frame out of order": lambda writer: writer.add_frame(
        0, timestamp_ns=999, world_from_ego=IDENTITY
    ),
    "time out of order": lambda writer: writer.add_frame(
        1, timestamp_ns=0, world_from_ego=IDENTITY
    ),
    "nan lidar pose": lambda writer: add_sweep(
        writer, some_points(), world_from_lidar=IDENTITY * torch.nan
    ),
    "zero points": lambda writer: add_sweep(writer, some_points(0)),
    "nan point": lambda writer: add_sweep(
        writer, SweepPoints(**{**vars(some_points(2)), "xyz_m": torch.full((2, 3), torch.nan)})
    ),
    "absurdly far point": lambda writer: add_sweep(
        writer, SweepPoints(**{**vars(some_points(2)), "xyz_m": torch.full((2, 3), 1e7)})
    ),
    "classes without names": lambda writer: add_sweep(
        writer, some_points(), semantics=torch.zeros(50, dtype=torch.uint8)
    ),
    "flat box": lambda writer: writer.add_box(some_box(size_m=(4.0, 0.0, 1.5))),
    "endless box": lambda writer: writer.add_box(some_box(size_m=(4.0, torch.inf, 1.5))),
    "nan box pose": lambda writer: writer.add_box(some_box(world_from_box=IDENTITY * torch.nan)),
    "image of another size": lambda writer: writer.add_image(some_record(), some_jpeg(16, 16)),
    "cut-off image": lambda writer: writer.add_image(some_record(), some_jpeg()[:-60]),
    "no image": lambda writer: writer.add_image(some_record(), b"GIF89a"),
    "empty image": lambda writer: writer.add_image(some_record(), b""),
    "camera name with a slash": lambda writer: writer.add_image(
        some_record(camera_name="../front"), some_jpeg()
    ),
}


@pytest.mark.parametrize("thing", BAD_THINGS)
def test_bad_input_is_one_line_with_its_place_and_leaves_nothing(tmp_path, thing):
    def write(writer):
        writer.add_frame(0, timestamp_ns=0, world_from_ego=IDENTITY)
        BAD_THINGS[thing](writer)

    with pytest.raises(DataError) as raised, SceneWriter(tmp_path, "rig", "a", HEADER) as writer:
        write(writer)
    assert "\n" not in str(raised.value)
    assert "frame" in str(raised.value) or "name" in str(raised.value)
    assert files_below(tmp_path) == []


def test_same_camera_twice_in_a_frame_is_refused(tmp_path):
    def write(writer):
        add_frame(writer)
        writer.add_image(some_record(), some_jpeg())

    with (
        pytest.raises(DataError, match="frame 0, camera front: given twice"),
        SceneWriter(tmp_path, "rig", "a", HEADER) as writer,
    ):
        write(writer)


def test_point_classes_of_another_number_are_refused(tmp_path):
    header = replace(HEADER, semantic_classes={0: "Ground"})

    def write(writer):
        writer.add_frame(0, timestamp_ns=0, world_from_ego=IDENTITY)
        add_sweep(writer, some_points(), semantics=torch.zeros(3, dtype=torch.uint8))

    with (
        pytest.raises(DataError, match="the columns of the points differ in length"),
        SceneWriter(tmp_path, "rig", "a", header) as writer,
    ):
        write(writer)


def test_image_before_any_frame_is_refused(tmp_path):
    with (
        pytest.raises(SceneError, match="add_frame must come before camera front"),
        SceneWriter(tmp_path, "rig", "a", HEADER) as writer,
    ):
        writer.add_image(some_record(), some_jpeg())


def test_unknown_distortion_is_refused():
    with pytest.raises(DataError, match="'spherical' is not known, expected one of none, brown"):
        Distortion("spherical", ())
    with pytest.raises(DataError, match="takes 4 terms, got 2"):
        Distortion("fisheye", (0.1, 0.2))
