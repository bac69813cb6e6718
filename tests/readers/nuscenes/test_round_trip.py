"""A scene written as nuScenes and read back is the same scene."""

import os
import subprocess
from pathlib import Path

import numpy as np
import pytest
import torch
from scene_differences import scene_differences

from lidarpainter_models.checks.doctor import check_scene
from lidarpainter_models.geometry.transforms import transform_points

DEVKIT_ENVIRONMENT = "NUSCENES_DEVKIT_PYTHON"
DEVKIT_READING = Path(__file__).parents[2] / "support" / "devkit_reading.py"


def test_scene_comes_back_as_it_was(street, read_street):
    assert len(read_street.frame_indices) == 7
    assert len(read_street.views) == 7 * 6
    found = scene_differences(street, read_street)
    # points are float32, three times
    found.require_rounding(metres=1e-6, point_m=5e-5, degrees=1e-5)


def test_boxes_have_the_times_at_which_they_were_seen(street, read_street):
    tracks = {track.actor_id: track for track in read_street.tracks}
    for track in street.tracks:
        apart_ns = (tracks[track.actor_id].timestamps_ns - track.timestamps_ns).abs()
        assert apart_ns.max() < 20_000  # 0.2 mm at 10 m/s


def test_doctor_accepts_the_scene(read_street):
    assert [check for check in check_scene(read_street) if check.verdict != "ok"] == []


def test_rings_and_intensities_are_kept(street, read_street):
    true_points, points = street.read_points(3), read_street.read_points(3)
    assert torch.equal(points.ring, true_points.ring)
    assert torch.equal(points.intensity, (255 * true_points.intensity).round())


def test_firings_that_met_nothing_are_no_points(street, read_street):
    assert read_street.read_points(0).num_points == street.read_points(0).num_points


def test_moving_is_what_travels(street, read_street):
    for track in read_street.tracks:
        path_m = track.world_from_box[:, :3, 3] - track.world_from_box[0, :3, 3]
        assert track.is_moving == bool(path_m.norm(dim=1).max() >= 1.0)
    assert 3 <= sum(track.is_moving for track in read_street.tracks) < len(street.tracks) / 2


@pytest.mark.slow
def test_official_devkit_reads_the_same(street_log, read_street, tmp_path):
    """Poses, lenses, points and boxes as the devkit computes them from the same tables."""
    python = os.environ.get(DEVKIT_ENVIRONMENT)
    if not python:
        pytest.skip(f"{DEVKIT_ENVIRONMENT} names no Python that has nuscenes-devkit")
    answers = tmp_path / "devkit.npz"
    subprocess.run([python, DEVKIT_READING, street_log.root, answers], check=True, timeout=120)
    devkit = dict(np.load(answers))
    global_from_world = read_street.global_from_world
    for view in read_street.views:
        key = f"{view.timestamp_ns // 1000}/{view.camera_name}"
        camera = view.camera
        pose = devkit.pop(f"pose/{key}")
        np.testing.assert_allclose(global_from_world @ camera.world_from_camera, pose, atol=1e-9)
        lens = [camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px]
        np.testing.assert_array_equal(lens, devkit.pop(f"lens/{key}"))
    for position, frame_index in enumerate(read_street.frame_indices):
        xyz_m = read_street.read_points(frame_index).xyz_m.double()
        points = devkit.pop(f"points/{position}")
        np.testing.assert_allclose(transform_points(global_from_world, xyz_m), points, atol=1e-4)
    for track in read_street.tracks:
        for row, position in enumerate(track.frame_indices.tolist()):
            box = devkit.pop(f"box/{position}/{track.actor_id}")
            pose = global_from_world @ track.world_from_box[row]
            # between key frames the devkit leaves out that boxes are seen within the turn
            np.testing.assert_allclose(pose, box[:16].reshape(4, 4), atol=1e-9 if box[19] else 1e-3)
            np.testing.assert_allclose(track.size_m, box[16:19], atol=1e-6)
    assert devkit == {}
