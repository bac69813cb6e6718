"""A real key frame: boxes and points land where others compute them, on the image."""

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from nuscenes_key_frame import (
    SCENE_NAME,
    draw_key_frame,
    number_of,
    read_key_frame,
    write_key_frame,
)

from lidarpainter_models.checks.doctor import check_scene
from lidarpainter_models.readers import ingest_scene
from lidarpainter_models.readers.nuscenes.sweeps import TURN_NS, read_lidar_points
from lidarpainter_models.readers.source_logs.folder import SourceFolder
from lidarpainter_models.scenes.driving_scene import DrivingScene

SPEED_MPS = 9.28
OVERLAY = Path(__file__).parents[3] / "docs/pictures/overlay_nuscenes.jpg"


@pytest.fixture(scope="module")
def folder(shared_folder):
    return shared_folder / "data/nuscenes_keyframe"


@pytest.fixture(scope="module")
def scene(folder, tmp_path_factory):
    root = tmp_path_factory.mktemp("key-frame")
    write_key_frame(folder, root / "log")
    return DrivingScene.open(ingest_scene("nuscenes", root / "log", SCENE_NAME, root / "store"))


@pytest.fixture(scope="module")
def firings(folder):
    """The sweep as it is stored: (columns, 32 lasers, x y z intensity ring)."""
    (file,) = folder.glob("*.pcd.bin")
    return np.fromfile(file, "<f4").reshape(-1, 32, 5).astype(float)


def test_key_frame_becomes_a_scene(scene):
    counts = scene.manifest["counts"]
    assert [counts[name] for name in ("frames", "images", "sweeps")] == [1, 6, 1]
    assert counts["boxes"] == 69
    assert [check.name for check in check_scene(scene) if check.verdict == "fail"] == []


def test_box_centres_land_on_the_stated_pixels(scene, folder):
    info, _ = read_key_frame(folder)
    centres_m = torch.stack([track.world_from_box[0, :3, 3] for track in scene.tracks])
    apart_px, num_boxes = 0.0, 0
    for camera_name, stated in info["cam_instances"].items():
        pixels_uv, depth_m = scene.view(0, camera_name).camera.project(centres_m)
        for box in stated:
            expected_uv = torch.tensor([number_of(value) for value in box["center_2d"]])
            same_depth = (depth_m - number_of(box["depth"])).abs() < 0.01
            distance_px = (pixels_uv - expected_uv).norm(dim=1)[same_depth]
            apart_px = max(apart_px, float(distance_px.min()))
            num_boxes += 1
    assert num_boxes == 84
    assert apart_px < 0.01


def test_boxes_hold_the_stated_number_of_points(scene, folder):
    info, _ = read_key_frame(folder)
    stated = np.array([number_of(box["num_lidar_pts"]) for box in info["instances"]])
    tracks = {track.actor_id: int(track.num_points[0]) for track in scene.tracks}
    counted = np.array([tracks[f"instance-{i}"] for i in range(len(stated))])
    assert stated.sum() > 1000
    assert (counted == stated).sum() >= 60  # the pickle has lost the boxes' small tilts
    assert np.abs(counted - stated).max() <= 0.05 * stated.max()


def test_points_are_stored_motion_compensated(firings):
    """Firings that met nothing are stored where the sensor was: along the way of the car."""
    distance_m = np.linalg.norm(firings[..., :3], axis=2)
    empty = (np.abs(firings[..., 0]) < 0.01) & (np.abs(firings[..., 2]) < 0.02) & (distance_m < 1)
    columns = np.nonzero(empty)[0]
    assert empty.sum() > 4000
    slope_m, start_m = np.polyfit(columns, firings[empty][:, 1], 1)
    off_m = firings[empty][:, 1] - (start_m + slope_m * columns)
    assert np.sqrt(np.mean(off_m**2)) < 1e-4
    assert start_m == pytest.approx(-0.45, abs=0.01)
    assert start_m + slope_m * (len(firings) - 1) == pytest.approx(0.0, abs=1e-3)


def elevation_spread_deg(firings, speed_mps):
    """Median over the lasers of half the middle 68 % of elevations, with a motion put back in."""
    time_s = -(1 - np.arange(len(firings)) / len(firings)) * TURN_NS / 1e9
    xyz_m = firings[..., :3].copy()
    xyz_m[..., 1] -= speed_mps * time_s[:, None]
    distance_m = np.linalg.norm(xyz_m, axis=2)
    elevation = np.degrees(np.arcsin(xyz_m[..., 2] / np.maximum(distance_m, 1e-6)))
    rings = [elevation[:, ring][distance_m[:, ring] > 3] for ring in range(2, 32)]
    return float(np.median([np.diff(np.percentile(ring, [16, 84]))[0] / 2 for ring in rings]))


def test_lasers_have_one_elevation_only_with_the_motion_put_back_in(firings):
    assert elevation_spread_deg(firings, 0.0) > 0.15
    assert elevation_spread_deg(firings, SPEED_MPS) < 0.025
    assert elevation_spread_deg(firings, 2 * SPEED_MPS) > 0.1


def test_azimuth_and_order_of_firing_agree_on_the_time(folder, firings):
    (file,) = folder.glob("*.pcd.bin")
    points = read_lidar_points(SourceFolder(folder), file.name)
    met = np.linalg.norm(firings[..., :3], axis=2) >= 1.0
    columns = np.nonzero(met)[0]
    fired_ns = ((columns + 0.5) / len(firings) - 1) * TURN_NS
    far = np.linalg.norm(points.xyz_m, axis=1) > 3  # near ones were seen from another place
    assert np.abs(points.time_offset_ns - fired_ns)[far].max() < 1_500_000
    assert np.median(np.abs(points.time_offset_ns - fired_ns)) < 500_000


def test_cameras_look_where_the_lidar_looks(scene):
    """Images are taken within 2.5 ms of the moment at which the LiDAR looks along their axis."""
    end_ns = int(scene.frame_timestamps_ns[0])
    shares = {"FRONT_LEFT": 35, "FRONT": 90, "FRONT_RIGHT": 145, "BACK_RIGHT": 200, "BACK": 270}
    for name, degrees in {**shares, "BACK_LEFT": 340}.items():
        looks_ns = end_ns - (1 - degrees / 360) * TURN_NS
        assert abs(scene.view(0, f"CAM_{name}").timestamp_ns - looks_ns) < 2_500_000


def test_overlay_in_the_documentation_is_what_the_reader_gives(folder):
    drawn = draw_key_frame(folder)
    shown = cv2.imread(str(OVERLAY))
    assert OVERLAY.stat().st_size <= 300 * 1024
    assert cv2.PSNR(drawn, shown) > 30
