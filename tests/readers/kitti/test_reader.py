"""A scene written as KITTI and read back is the same scene."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from kitti_log import DRIVE, write_kitti_raw
from nuscenes_log import reduced
from scene_differences import scene_differences
from written_logs import WRITERS

from lidarpainter_models.checks.doctor import check_scene
from lidarpainter_models.readers import ingest_scene
from lidarpainter_models.scenes.driving_scene import DrivingScene

REAL = "data/strangers/kitti/drive_0005"
LEAN_DEG = 1.0
"""A tracklet turns about the LiDAR's upright axis alone, a label about the camera's."""


@pytest.fixture(scope="module")
def read(tmp_path_factory):
    """A street written in both layouts: what a log was written from, and what is read of it."""

    @cache
    def make(name):
        folder = tmp_path_factory.mktemp("log")
        log = WRITERS[name](folder)
        truth = DrivingScene.open(next((folder / "street/scenes").glob("*/*")))
        scene = log.read(tmp_path_factory.mktemp("store"))
        return log, truth, scene

    return make


@pytest.mark.parametrize(
    "name", ["kitti, tracking", pytest.param("kitti, raw", marks=pytest.mark.slow)]
)
def test_doctor_accepts_a_street_in_either_layout(read, name):
    _, truth, scene = read(name)
    assert [check for check in check_scene(scene) if check.verdict != "ok"] == []
    assert len(scene.views) == len(truth.views) == 6
    for view, true_view in zip(scene.views, truth.views, strict=True):
        read_px, true_px = scene.read_image(view).float(), truth.read_image(true_view).float()
        assert float((read_px - true_px).abs().mean()) < 2  # a JPEG made of a JPEG
        for length in ("fx_px", "fy_px", "cx_px", "cy_px"):
            lens = getattr(view.camera, length)
            assert lens == pytest.approx(getattr(true_view.camera, length))


def test_layouts_give_the_same_scene_but_for_the_names_of_actors(read):
    raw, tracked = read("kitti, raw")[2], read("kitti, tracking")[2]
    tracked.tracks = tuple(
        replace(track, actor_id=track.actor_id.replace("track-", "tracklet-"))
        for track in tracked.tracks
    )
    found = scene_differences(raw, tracked)
    assert found.num_other_images == found.num_unpaired_boxes == 0
    assert max(found.camera_centre_m, found.box_centre_m) < 1e-4
    assert found.point_m < 1e-4


def test_real_drive_comes_back_from_a_raw_folder(tmp_path, shared_folder):
    real = DrivingScene.open(shared_folder / REAL)
    real = reduced(real, num_frames=4, cameras=("left", "right"), num_actors=3)
    names = {"image_02": "left", "image_03": "right"}
    write_kitti_raw(real, tmp_path / "kitti", names)
    scene = DrivingScene.open(ingest_scene("kitti", tmp_path / "kitti", DRIVE, tmp_path / "store"))
    real.tracks = tuple(
        replace(track, actor_id=f"tracklet-{number}") for number, track in enumerate(real.tracks)
    )
    frames = list(zip(real.frame_indices, scene.frame_indices, strict=True))
    found = scene_differences(real, scene, frames=frames, camera_names=names)
    assert found.num_unpaired_boxes == 0
    assert found.intrinsics < 1e-9
    assert max(found.camera_centre_m, found.box_centre_m) < 1e-6  # rounding 4000 km from the origin
    assert found.camera_rotation_deg < 1e-9
    assert found.point_m < 5e-5  # float32, twice
    assert found.box_rotation_deg < LEAN_DEG
    apart = [
        float((real.read_image(a).float() - scene.read_image(b).float()).abs().mean())
        for a, b in zip(real.views, scene.views, strict=True)
    ]
    assert np.mean(apart) < 2
