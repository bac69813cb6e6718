"""A street written out as PandaSet and read back is the same street."""

import numpy as np
import pytest
import torch
from pandaset_log import CAMERA_NAMES, far_away_frame, set_boxes_upright, write_pandaset_log
from scene_differences import scene_differences

from lidarpainter_models.checks.doctor import check_scene
from lidarpainter_models.readers import ingest_scene
from lidarpainter_models.scenes.driving_scene import DrivingScene
from lidarpainter_models.synthetic import (
    RigCamera,
    RigLidar,
    SyntheticStreet,
    SyntheticStreetConfig,
    record_street,
)

YAW_RAD = dict(zip(CAMERA_NAMES, np.radians([0, 57, -57, 90, -90, 180]).tolist(), strict=True))


@pytest.fixture(scope="module")
def scenes(tmp_path_factory):
    """The street, far from the origin of its dataset, and what the reader made of its log."""
    folder = tmp_path_factory.mktemp("round-trip")
    cameras = tuple(
        RigCamera(name=name, focal_per_width=0.6 + 0.01 * index, yaw_rad=YAW_RAD[name])
        for index, name in enumerate(CAMERA_NAMES)
    )
    config = SyntheticStreetConfig(
        seed=5,
        num_frames=4,
        width_px=96,
        height_px=64,
        samples_per_axis=1,
        cameras=cameras,
        lidar=RigLidar(columns=600),
    )
    truth = DrivingScene.open(record_street(SyntheticStreet(config), folder / "truth"))
    set_boxes_upright(truth)
    truth.manifest["global_from_world"] = far_away_frame().reshape(16).tolist()
    write_pandaset_log(truth, folder / "log")
    read = DrivingScene.open(ingest_scene("pandaset", folder / "log", "001", folder / "store"))
    return truth, read


def test_street_comes_back_as_it_was(scenes):
    found = scene_differences(*scenes)
    found.require_rounding(metres=1e-3, point_m=2e-3, degrees=0.01)


def test_classes_times_and_motion_come_back(scenes):
    truth, read = scenes
    assert read.semantic_classes == truth.semantic_classes
    for true_frame, frame in zip(truth.frame_indices, read.frame_indices, strict=True):
        assert torch.equal(read.read_semantics(frame), truth.read_semantics(true_frame))
        (true_sweep,), (sweep,) = truth.sweeps_of(true_frame), read.sweeps_of(frame)
        times_ns = sweep.timestamp_ns + read.read_sweep(sweep).time_offset_ns.long()
        true_ns = true_sweep.timestamp_ns + truth.read_sweep(true_sweep).time_offset_ns.long()
        assert (times_ns - true_ns).abs().max() < 1000  # float64 seconds since 1970
    for true_view in truth.views:
        stated = read.image_record(read.view(*true_view.key))
        assert abs(stated.timestamp_ns - true_view.timestamp_ns) < 1000
    moving = {track.actor_id: track.is_moving for track in truth.tracks}
    travelled = {track.actor_id for track in truth.tracks if moving[track.actor_id]}
    assert {track.actor_id for track in read.tracks if track.is_moving} <= travelled


def test_doctor_accepts_what_came_back(scenes):
    assert [check for check in check_scene(scenes[1]) if check.verdict == "fail"] == []
