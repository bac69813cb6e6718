"""Real files of the Waymo Open Dataset: what is decoded fits the dataset's own figures.

There is a frame with images and labels but no range images, one without images, and two small
components of version 2. None of them is a scene; each is decoded as far as it goes.
"""

import cv2
import numpy as np
import pytest
import torch
from waymo_edits import records_in
from waymo_real import RealFrame, all_of, fields, write_overlay

from lidarpainter_models.errors import DataError
from lidarpainter_models.geometry.boxes import box_corners
from lidarpainter_models.geometry.transforms import invert_rigid, is_rigid, transform_points
from lidarpainter_models.readers import ingest_scene, list_sequences
from lidarpainter_models.readers.waymo.calibration import CAMERA_NAMES, TOP
from lidarpainter_models.readers.waymo.cameras import exposure_s, readout_s
from lidarpainter_models.readers.waymo.log import actor_name
from lidarpainter_models.readers.waymo.parquet_rows import ParquetRows

FRAME, LABELS_ONLY = "pvps_data_one_frame", "mmdet3d_val"
SEGMENT = "10023947602400723454_1120_000_1140_000"


@pytest.fixture(scope="module")
def folder(shared_folder):
    return shared_folder / "data/waymo_frame"


@pytest.fixture(scope="module")
def real(folder):
    return RealFrame.read(folder / f"{FRAME}.tfrecord")


def test_frame_has_five_cameras_five_lidars_and_its_labels(real):
    assert set(real.segment.cameras) == set(CAMERA_NAMES.values()) == set(real.images)
    assert len(real.segment.lidars) == 5
    assert len(real.segment.lidars[TOP].beams_rad) == 64
    assert len(real.frame.labels) == 75
    kinds = [label.category for label in real.frame.labels]
    assert [kinds.count(kind) for kind in ("vehicle", "pedestrian", "sign", "cyclist")] == [
        *(37, 12, 25, 1)
    ]


def test_sensors_sit_where_a_car_has_them(real):
    front = real.segment.cameras["FRONT"]
    assert 2000 < front.lens.fx_px < 2100
    assert (front.lens.width_px, front.lens.height_px) == (1920, 1280)
    assert 1.0 < float(front.lens.world_from_camera[2, 3]) < 2.5
    forward = {
        name: camera.lens.world_from_camera[:3, 2] for name, camera in real.segment.cameras.items()
    }
    assert float(forward["FRONT"][0]) > 0.99
    assert float(forward["SIDE_LEFT"][1]) > 0.99
    assert float(forward["SIDE_RIGHT"][1]) < -0.99
    down = front.lens.world_from_camera[:3, 1]
    assert float(down[2]) < -0.99
    assert 2.0 < float(real.segment.lidars[TOP].vehicle_from_lidar[2, 3]) < 2.4


def test_cameras_follow_the_lidar_around_the_car(real):
    """The turn begins behind and goes clockwise: left before ahead before right."""
    order = ["SIDE_LEFT", "FRONT_LEFT", "FRONT", "FRONT_RIGHT", "SIDE_RIGHT"]
    start_s = real.frame.start_us / 1e6
    times_s = [exposure_s(real.images[name]) - start_s for name in order]
    assert times_s == sorted(times_s)
    expected_s = [0.1 * share for share in (0.25, 0.375, 0.5, 0.625, 0.75)]
    assert np.abs(np.array(times_s) - expected_s).max() < 0.003
    for image in real.images.values():
        assert readout_s(image) == pytest.approx(0.044, abs=0.001)
        assert abs(image.pose_time_s - exposure_s(image)) < 0.006


def test_boxes_project_onto_the_datasets_own_rectangles(real, folder):
    """The file holds the labels as its makers projected them, with their camera model."""
    content, *_ = records_in((folder / f"{FRAME}.tfrecord").read_bytes())
    labels = {label.actor_id: label for label in real.frame.labels}
    tracks = {track.actor_id: track for track in real.tracks()}
    gaps_px = []
    for projected in all_of(content, 9):
        name = CAMERA_NAMES[all_of(projected, 1)[0]]
        for rectangle in all_of(projected, 2):
            actor_id = actor_name(all_of(rectangle, 4)[0].decode()[:22], "label")
            box = dict(fields(all_of(rectangle, 1)[0]))
            half_px = np.array([box[5], box[4]]) / 2
            centre_px = np.array([box[1], box[2]])
            stated_px = np.concatenate([centre_px - half_px, centre_px + half_px])
            found_px = rectangle_px(real.record(name), tracks[actor_id])
            if found_px is not None and is_whole(found_px, real.record(name).camera):
                gaps_px.append(np.abs(found_px - stated_px).max())
    assert len(labels) == len(tracks) == 75
    assert len(gaps_px) > 30
    assert max(gaps_px) < 0.5


def rectangle_px(record, track):
    """Left, top, right and bottom of a box in the distorted image; None if it is too near."""
    corners = transform_points(track.world_from_box[0], box_corners(track.size_m.double()))
    points = transform_points(invert_rigid(record.camera.world_from_camera), corners).numpy()
    if points[:, 2].min() < 0.5:
        return None
    lens = record.camera
    matrix = np.array([[lens.fx_px, 0, lens.cx_px], [0, lens.fy_px, lens.cy_px], [0, 0, 1]])
    terms = np.array(record.distortion.terms)
    pixels_uv, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix, terms)
    return np.concatenate([pixels_uv[:, 0].min(axis=0), pixels_uv[:, 0].max(axis=0)])


def is_whole(rectangle, camera):
    """Whether a rectangle lies inside of the image, so that it was not clipped."""
    left, top, right, bottom = rectangle
    return min(left, top) > 5 and right < camera.width_px - 5 and bottom < camera.height_px - 5


def test_ids_that_begin_with_a_sign_become_names(real):
    ids = {label.actor_id for label in real.frame.labels}
    assert "id-zRacoa4APhIbgKYpgbiDQ" in ids
    assert "07oWyczrNggYTqwYAT2UBA" in ids
    assert len(ids) == 75


def test_overlay_is_drawn(folder, tmp_path):
    write_overlay(folder / f"{FRAME}.tfrecord", tmp_path / "overlay.jpg")
    drawn = cv2.imread(str(tmp_path / "overlay.jpg"))
    assert drawn.shape == (853, 1280, 3)
    assert (drawn == np.array([80, 255, 80])).all(axis=2).sum() < drawn[..., 0].size / 100


@pytest.mark.parametrize(
    ("name", "complaint"),
    [(FRAME, "no LiDAR has a point"), (LABELS_ONLY, "zero images, expected at least one")],
)
def test_frame_that_is_no_scene_is_refused(folder, tmp_path, name, complaint):
    assert name in list_sequences("waymo", folder)
    with pytest.raises(DataError) as raised:
        ingest_scene("waymo", folder, name, tmp_path)
    assert complaint in str(raised.value)
    assert f"{name}.tfrecord, record 0" in str(raised.value)


def test_poses_of_version_2_are_a_drive(folder):
    path = folder / f"v2_parquet/vehicle_pose/{SEGMENT}.parquet"
    pose_column = "[VehiclePoseComponent].world_from_vehicle.transform"
    rows = ParquetRows(path, ("key.frame_timestamp_micros", pose_column)).small_table()
    times_us = [row.whole_number("key.frame_timestamp_micros") for row in rows]
    poses = torch.stack(
        [torch.from_numpy(row.numbers(pose_column).astype(float)).reshape(4, 4) for row in rows]
    )
    assert len(rows) == 199
    assert (np.diff(times_us) > 99_000).all()
    assert (np.diff(times_us) < 101_000).all()
    assert bool(is_rigid(poses).all())
    speed_mps = poses[:, :3, 3].diff(dim=0).norm(dim=1).numpy() / (np.diff(times_us) / 1e6)
    assert 0 <= speed_mps.min() <= speed_mps.max() < 30


def test_keypoints_of_version_2_stream_in_the_order_of_the_poses(folder):
    names = ("key.frame_timestamp_micros", "key.camera_name")
    poses = ParquetRows(folder / f"v2_parquet/vehicle_pose/{SEGMENT}.parquet", names[:1])
    times_us = {row.whole_number(names[0]) for row in poses.small_table()}
    keypoints = ParquetRows(folder / f"v2_parquet/camera_hkp/{SEGMENT}.parquet", names)
    seen_us = [row.whole_number(names[0]) for row in keypoints.stream()]
    assert len(seen_us) == 15844
    assert seen_us == sorted(seen_us)
    assert set(seen_us) <= times_us


def test_components_that_are_missing_are_named(folder, tmp_path):
    assert SEGMENT in list_sequences("waymo", folder)
    with pytest.raises(DataError, match=r"camera_calibration.*parquet: the file is missing"):
        ingest_scene("waymo", folder, SEGMENT, tmp_path)
