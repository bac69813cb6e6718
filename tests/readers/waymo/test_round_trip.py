"""A known scene, written as Waymo's files of either release, comes back as it was."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from camera_rows import camera_rows
from scene_differences import scene_differences
from scipy.spatial import cKDTree
from waymo_components import write_v2
from waymo_numbers import SEGMENT
from waymo_records import frame_messages, tfrecord, write_v1
from waymo_truth import CAMERAS, LENS_TERMS, NEAR_LIDARS, TURN_S

from lidarpainter_models.checks.doctor import check_scene
from lidarpainter_models.errors import DataError
from lidarpainter_models.readers import ingest_scene, list_sequences
from lidarpainter_models.scenes.driving_scene import DrivingScene
from lidarpainter_models.scenes.records import Distortion


def test_scene_comes_back(truth, scene):
    found = scene_differences(truth.scene, scene)
    # far below the millimetre that is asked for: what is left is float32 and whole microseconds
    found.require_rounding(metres=1e-5, point_m=5e-4, degrees=1e-5)


def test_no_point_is_lost_or_made(truth, scene):
    for frame in scene.frame_indices:
        for true_sweep in truth.scene.sweeps_of(frame):
            sweep = next(s for s in scene.sweeps_of(frame) if s.lidar_name == true_sweep.lidar_name)
            assert sweep.num_points == true_sweep.num_points
            apart = sweep.world_from_lidar - scene_pose(truth, scene, true_sweep)
            assert apart.abs().max() < 1e-6


def scene_pose(truth, scene, sweep):
    """A LiDAR's true pose in the world of the scene that was read."""
    return (
        torch.linalg.inv(scene.global_from_world)
        @ truth.scene.global_from_world
        @ sweep.world_from_lidar
    )


def test_points_keep_echo_beam_strength_and_moment(truth, scene):
    for true_sweep, sweep in paired_sweeps(truth.scene, scene, frame=1):
        true_points, points = truth.scene.read_sweep(true_sweep), scene.read_sweep(sweep)
        apart_m, nearest = cKDTree(global_points(scene, points)).query(
            global_points(truth.scene, true_points), k=1
        )
        # where two echoes of neighbouring beams all but meet, the nearest may be the other one
        alone = apart_m < 1e-3
        assert alone.all()
        assert same_share(points.return_index[nearest], true_points.return_index) > 0.999
        assert same_share(points.ring[nearest], true_points.ring) > 0.999
        assert same_share(points.intensity[nearest], true_points.intensity) > 0.999
        late_ns = points.time_offset_ns[nearest] - true_points.time_offset_ns
        assert (late_ns.abs() < 2000).float().mean() > 0.999  # times are whole microseconds


def paired_sweeps(true_scene, scene, frame):
    by_name = {sweep.lidar_name: sweep for sweep in scene.sweeps_of(frame)}
    return [(sweep, by_name[sweep.lidar_name]) for sweep in true_scene.sweeps_of(frame)]


def global_points(scene, points):
    pose = scene.global_from_world
    return (points.xyz_m.double() @ pose[:3, :3].T + pose[:3, 3]).numpy()


def same_share(first, second):
    return float((first.double() == second.double()).double().mean())


def test_both_releases_give_the_same_scene(scenes):
    assert scenes["v1"].content_digest == scenes["v2"].content_digest


def test_frames_and_images_keep_their_moments(truth, scene):
    late_ns = scene.frame_timestamps_ns - truth.scene.frame_timestamps_ns
    assert late_ns.abs().max() < 1000
    true_ns = {view.key: view.timestamp_ns for view in truth.scene.views}
    assert max(abs(view.timestamp_ns - true_ns[view.key]) for view in scene.views) < 1000


def test_lens_and_shutter_are_kept(scene):
    for row in camera_rows(scene):
        assert row["rolling_shutter_direction"] == CAMERAS[row["camera"]].readout
        assert row["rolling_shutter_s"] == pytest.approx(0.044, abs=2e-6)
        assert row["distortion_model"] == "brown"
        assert tuple(row["distortion_terms"]) == LENS_TERMS


def test_camera_synced_box_holds_when_its_camera_reads_the_centre(scene):
    seen = 0
    for track in scene.tracks:
        view = scene.view(1, "FRONT")
        row = int((track.frame_indices == 1).nonzero()[0, 0])
        centre = track.world_from_box[row, :3, 3][None]
        pixel_uv, depth_m = lens_of(scene, view).project(centre)
        if not 4 < float(depth_m[0]) < 80 or not 5 < float(pixel_uv[0, 0]) < 90:
            continue
        if not 0 < float(pixel_uv[0, 1]) < 64:
            continue
        share = float(pixel_uv[0, 0]) / 96
        expected_ns = view.timestamp_ns + (share - 0.5) * 0.044e9
        assert abs(int(track.timestamps_ns[row]) - expected_ns) < 0.5e6
        seen += 1
    assert seen > 5


def lens_of(scene, view):
    """The lens as calibrated, its distortion aside, where the image was taken."""
    row = camera_rows(scene)[view.index]
    pinhole = {name: row[name] for name in ("fx_px", "fy_px", "cx_px", "cy_px")}
    return replace(view.camera, **pinhole)


def test_other_box_holds_when_the_lidar_saw_the_actor(scene):
    checked = 0
    position = scene.frame_position(1)
    begin_ns = int(scene.frame_timestamps_ns[position]) - TURN_S / 2 * 1e9
    ego_from_world = torch.linalg.inv(scene.world_from_ego[position])
    for track in scene.tracks:
        row = int((track.frame_indices == 1).nonzero()[0, 0])
        x_m, y_m, _ = (ego_from_world @ track.world_from_box[row, :, 3])[:3].tolist()
        azimuth = np.arctan2(y_m, x_m)
        if not np.radians(35) < abs(azimuth) < np.radians(160) or np.hypot(x_m, y_m) < 5:
            continue  # FRONT may see it, the turn may begin in it, or it spans many columns
        expected_ns = begin_ns + (np.pi - azimuth) / (2 * np.pi) * TURN_S * 1e9
        assert abs(int(track.timestamps_ns[row]) - expected_ns) < 12e6
        checked += 1
    assert checked > 10


def test_actors_are_named_and_sorted_as_in_the_log(truth, scene):
    kinds = {track.actor_id: (track.category, track.is_moving) for track in scene.tracks}
    assert kinds == {
        track.actor_id: (track.category, track.is_moving) for track in truth.scene.tracks
    }
    assert {category for category, _ in kinds.values()} == {"vehicle", "pedestrian"}


def test_stated_number_of_points_is_that_inside(truth, scene):
    true_counts = {track.actor_id: track.num_points.tolist() for track in truth.scene.tracks}
    assert {track.actor_id: track.num_points.tolist() for track in scene.tracks} == true_counts
    assert max(max(counts) for counts in true_counts.values()) > 20


def test_scene_is_sound(scene):
    assert [check for check in check_scene(scene) if check.verdict == "fail"] == []
    assert scene.lidar_names == ("TOP", *NEAR_LIDARS)
    assert scene.manifest["licence"].startswith("Waymo Open Dataset License")


def test_log_without_a_second_echo_or_labels_is_read(components, tmp_path):
    for component in ("lidar_box", "lidar_camera_synced_box"):
        (components.root / component / f"{SEGMENT}.parquet").unlink()
        (components.root / component).rmdir()
    scene = DrivingScene.open(components.ingest(tmp_path / "store"))
    assert scene.tracks == ()


def test_release_shows_by_what_lies_there(tiny_truth, tmp_path):
    write_v1(tiny_truth, tmp_path / "a/training", "one")
    write_v2(tiny_truth, tmp_path / "a/validation", "two")
    assert list_sequences("waymo", tmp_path / "a") == ("one", "two")
    for name in ("one", "two"):
        ingest_scene("waymo", tmp_path / "a", name, tmp_path / "store")
    assert sorted(path.name for path in (tmp_path / "store/scenes/waymo").iterdir()) == [
        "one",
        "two",
    ]


def test_segment_that_lies_there_twice_is_refused(tiny_truth, tmp_path):
    write_v1(tiny_truth, tmp_path / "a/training", "one")
    write_v2(tiny_truth, tmp_path / "a/validation", "one")
    with pytest.raises(DataError, match=r"segment one lies at .*, too; expected it once"):
        ingest_scene("waymo", tmp_path / "a", "one", tmp_path / "store")


def test_pinhole_camera_stays_one(tiny_truth, tmp_path):
    """Terms that are all zero mean no distortion: nothing is resampled for them."""
    file = tmp_path / "segment-x.tfrecord"
    plain = frame_messages(tiny_truth)
    terms = np.array(LENS_TERMS).tobytes()
    for term in np.frombuffer(terms, np.float64):
        plain = [record.replace(term.tobytes(), bytes(8)) for record in plain]
    file.write_bytes(tfrecord(plain))
    scene = DrivingScene.open(ingest_scene("waymo", tmp_path, "x", tmp_path / "store"))
    assert {row["distortion_model"] for row in camera_rows(scene)} == {Distortion().model}
