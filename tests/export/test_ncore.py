"""A scene written as NCore is opened by NVIDIA's own library, field by field, and read back."""

import sys
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from av2_log import CAMERAS
from commands import refuse, succeed
from drawn_streets import recorded_street
from ncore.data import FrameTimepoint, ShutterType
from ncore.data.v4 import SequenceComponentGroupsReader, SequenceLoaderV4
from nuscenes_log import FAR_AWAY
from scene_differences import scene_differences

from lidarpainter_models.errors import MissingPackageError, SceneError
from lidarpainter_models.export.ncore_files import write_ncore
from lidarpainter_models.geometry.transforms import invert_rigid, transform_points
from lidarpainter_models.readers import ingest_scene
from lidarpainter_models.scenes.driving_scene import DrivingScene
from lidarpainter_models.scenes.records import Distortion
from lidarpainter_models.synthetic import RigLidar

NAME = "synthetic_street-0005"


def written(scene, folder, frames=None):
    """What the library makes of a scene, and what was told of it."""
    folder.mkdir()
    told = write_ncore(folder, scene, frames or set(scene.frame_indices), lambda *_: None)
    name = f"{scene.dataset}_{scene.sequence}"
    return SequenceLoaderV4(SequenceComponentGroupsReader([folder / f"{name}.json"])), told


@pytest.fixture(scope="module")
def street(tmp_path_factory):
    """Two cameras and a LiDAR that is called as a preset, far from the origin of their frame."""
    lidar = RigLidar(name="pandar64", columns=360)
    scene = recorded_street(tmp_path_factory.mktemp("street"), CAMERAS, lidar=lidar)
    scene.manifest["global_from_world"] = FAR_AWAY.reshape(16).tolist()
    return scene


@pytest.fixture(scope="module")
def opened(street, tmp_path_factory):
    return written(street, tmp_path_factory.mktemp("out") / "log")


def test_a_sequence_says_whose_it_is(street, opened):
    loader, told = opened
    assert loader.sequence_id == NAME
    assert loader.generic_meta_data["licence"] == street.manifest["licence"]
    assert loader.generic_meta_data["source_digest"] == street.content_digest
    assert (told["num_images"], told["num_sweeps"]) == (len(street.views), len(street.sweeps))
    assert told["num_boxes"] == sum(len(track.timestamps_ns) for track in street.tracks) > 0


def test_cameras_have_their_images_lenses_times_and_poses(street, opened):
    loader, told = opened
    assert sorted(loader.camera_ids) == sorted(street.camera_names)
    assert told["camera_apart_m"] < 1e-3
    for name in loader.camera_ids:
        camera, views = loader.get_camera_sensor(name), street.views_of(name)
        assert camera.frames_count == len(views)
        assert camera.get_mask_images() == {}
        for number, view in enumerate(views):
            record, model = street.image_record(view), camera.model_parameters
            image = camera.get_frame_handle(number).get_data()
            assert image.get_encoded_image_data() == street.read_jpeg(view)
            assert image.get_encoded_image_format() == "jpeg"
            assert model.resolution.tolist() == [view.camera.width_px, view.camera.height_px]
            focal_px = (record.camera.fx_px, record.camera.fy_px)
            assert model.focal_length.tolist() == pytest.approx(focal_px, rel=1e-6)
            centre_px = (record.camera.cx_px, record.camera.cy_px)
            assert model.principal_point.tolist() == pytest.approx(centre_px, rel=1e-6)
            assert not model.radial_coeffs.any()
            assert model.shutter_type == ShutterType.GLOBAL
            assert camera.frames_timestamps_us[number].tolist() == [record.timestamp_ns // 1000] * 2
            placed = camera.get_frames_T_sensor_target("world", number, FrameTimepoint.START)
            recorded = record.camera.world_from_camera.numpy()
            assert np.abs(placed - recorded).max() < 1e-3
            kept = camera.get_frame_generic_data(number, "world_from_camera")
            assert np.array_equal(kept, recorded)


def test_points_stand_where_they_were_with_their_times_and_strength(street, opened):
    lidar = opened[0].get_lidar_sensor("pandar64")
    for number, sweep in enumerate(street.sweeps):
        points = street.read_sweep(sweep)
        cloud = lidar.get_frame_point_cloud(
            number, motion_compensation=True, with_start_points=False
        )
        world = lidar.get_frames_T_sensor_target("world", number, FrameTimepoint.END)
        xyz_m = transform_points(
            torch.from_numpy(world), torch.from_numpy(cloud.xyz_m_end).double()
        )
        assert float((xyz_m - points.xyz_m).norm(dim=1).max()) < 1e-3
        times_us = lidar.get_frame_ray_bundle_timestamp_us(number).astype(np.int64)
        assert np.abs(times_us * 1000 - street.measured_ns(sweep).numpy()).max() <= 500
        strength = lidar.get_frame_ray_bundle_return_intensity(number)
        assert np.allclose(strength * 255, points.intensity.numpy(), atol=1e-3)
        assert lidar.get_frame_ray_bundle_return_valid_mask(number).all()
        assert np.array_equal(lidar.get_frame_generic_data(number, "ring"), points.ring.numpy())


def test_model_of_the_lidar_looks_where_its_rays_do(opened):
    lidar = opened[0].get_lidar_sensor("pandar64")
    model = lidar.model_parameters
    assert (model.type(), model.n_rows, model.n_columns) == ("row-offset-spinning", 64, 1800)
    for number in range(lidar.frames_count):
        row, column = lidar.get_frame_ray_bundle_model_element(number).astype(int).T
        elevation = model.row_elevations_rad[row]
        azimuth = model.column_azimuths_rad[column] + model.row_azimuth_offsets_rad[row]
        flat = np.cos(elevation)
        rays = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)], 1)
        seen = lidar.get_frame_ray_bundle_direction(number)
        apart_deg = np.degrees(np.arccos((rays * seen).sum(axis=1).clip(-1, 1)))
        assert np.median(apart_deg) < 0.15  # half a column is 0.1


def test_boxes_stand_where_they_were_at_their_times(street, opened):
    loader = opened[0]
    true = {
        (track.actor_id, int(time_ns) // 1000): (track, pose)
        for track in street.tracks
        for time_ns, pose in zip(track.timestamps_ns, track.world_from_box, strict=True)
    }
    found = list(loader.get_cuboid_track_observations())
    assert len(found) == len(true)
    for one in found:
        track, pose = true[one.track_id, one.timestamp_us]
        assert one.class_id == track.category
        assert one.reference_frame_id == "pandar64"
        placed = one.transform("world", one.reference_frame_timestamp_us, loader.pose_graph)
        assert np.abs(placed.bbox3.to_array()[:3] - pose[:3, 3].numpy()).max() < 1e-3
        assert placed.bbox3.dim == pytest.approx(track.size_m.tolist(), rel=1e-6)


def test_frame_of_the_log_is_kept(street, opened):
    time = np.array(opened[0].sequence_timestamp_interval_us.start, np.uint64)
    placed = opened[0].pose_graph.evaluate_poses("world", "world_global", time)
    assert np.array_equal(placed, street.global_from_world.numpy())


def test_scene_comes_back_through_our_own_reader(street, tmp_path):
    written(street, tmp_path / "log")
    read = DrivingScene.open(ingest_scene("ncore", tmp_path / "log", NAME, tmp_path / "store"))
    assert read.manifest["licence"] == street.manifest["licence"]
    found = scene_differences(street, read)
    assert found.num_other_images == found.num_unpaired_boxes == 0
    assert max(found.camera_centre_m, found.box_centre_m) < 1e-3
    assert found.camera_rotation_deg < 0.01
    assert found.point_m < 1e-4
    for true_sweep, sweep in zip(street.sweeps, read.sweeps, strict=True):
        assert torch.equal(read.read_column(sweep, "ring"), street.read_column(true_sweep, "ring"))


def test_command_takes_a_scene_that_has_no_run(street, tmp_path):
    store = SimpleNamespace(root=street.path.parents[2])
    words = ("--format", "ncore", "--frames", "0:2", "--out", tmp_path / "log")
    made = succeed("export", "synthetic/street-0005", *words, "--json", store=store).json
    assert (made["scene"], made["run_id"]) == ("synthetic/street-0005", None)
    assert (made["num_images"], made["num_sweeps"]) == (4, 2)
    assert made["num_bytes"] == sum(file.stat().st_size for file in (tmp_path / "log").iterdir())
    assert "no complete run of synthetic/other" in refuse(
        "export", "synthetic/other", *words, store=store
    )
    assert "is there already" in refuse("export", "synthetic/street-0005", *words, store=store)


def test_some_frames_alone_are_written(street, tmp_path):
    loader, told = written(street, tmp_path / "log", {street.frame_indices[1]})
    assert (told["num_images"], told["num_sweeps"]) == (2, 1)
    assert loader.get_camera_sensor(street.camera_names[0]).frames_count == 1


def test_what_ncore_cannot_hold_is_refused_in_one_line(street, tmp_path, monkeypatch):
    with pytest.raises(SceneError, match="nothing is left to export"):
        written(street, tmp_path / "none", {99})
    recorded, first = street.image_record, street.views[0]

    def longer(view):
        record = recorded(view)
        lens = replace(record.camera, fx_px=record.camera.fx_px + (view is first))
        return replace(record, camera=lens)

    monkeypatch.setattr(street, "image_record", longer)
    with pytest.raises(SceneError, match="changes its lens"):
        written(street, tmp_path / "lenses")
    lens = Distortion("mei", (1.0, 0.0, 0.0, 0.0, 0.0))
    monkeypatch.setattr(
        street, "image_record", lambda view: replace(recorded(view), distortion=lens)
    )
    with pytest.raises(SceneError, match="a lens of model mei, expected none, brown or fisheye"):
        written(street, tmp_path / "mei")


def test_absent_library_is_named(street, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "ncore.data", None)
    with pytest.raises(MissingPackageError, match=r"pip install 'lidarpainter\[ncore\]'"):
        written(street, tmp_path / "log")


@pytest.mark.slow
def test_real_log_is_opened_and_comes_back(tmp_path, shared_folder):
    root = shared_folder / "data/pandaset"
    path = ingest_scene("pandaset", root, "002", tmp_path / "store", frames=slice(0, 28))
    scene = DrivingScene.open(path)
    loader, told = written(scene, tmp_path / "log")
    assert told["num_images"] == 168
    assert told["camera_apart_m"] < 0.03  # PandaSet's cameras are not quite where its ego says
    assert told["camera_apart_deg"] < 0.15
    camera = loader.get_camera_sensor("front_camera")
    assert camera.model_parameters.shutter_type == ShutterType.ROLLING_TOP_TO_BOTTOM
    assert np.ptp(camera.frames_timestamps_us, axis=1).tolist() == [40_000] * 28
    view = scene.views_of("front_camera")[5]
    assert camera.get_frame_handle(5).get_data().get_encoded_image_data() == scene.read_jpeg(view)
    lidar = loader.get_lidar_sensor("pandar64")
    sweep = [one for one in scene.sweeps if one.lidar_name == "pandar64"][5]
    cloud = lidar.get_frame_point_cloud(5, motion_compensation=True, with_start_points=False)
    world = torch.from_numpy(lidar.get_frames_T_sensor_target("world", 5, FrameTimepoint.END))
    xyz_m = transform_points(world, torch.from_numpy(cloud.xyz_m_end).double())
    assert float((xyz_m - scene.read_column(sweep, "xyz_m")).norm(dim=1).max()) < 1e-3
    assert lidar.model_parameters.n_rows == 64
    again = ingest_scene("ncore", tmp_path / "log", "pandaset_002", tmp_path / "again")
    require_same_log(scene, DrivingScene.open(again))


def require_same_log(scene, again):
    """Images, points and boxes come back; an image may have become one of the frame before."""
    views = {scene.read_jpeg(view): view for view in scene.views}
    assert len(again.views) >= len(views) - 1  # the first of all may be half a turn before a sweep
    for view in again.views:
        true = views[again.read_jpeg(view)]
        assert view.timestamp_ns == pytest.approx(true.timestamp_ns, abs=1000)
        first, second = (one.camera.world_from_camera for one in (true, view))
        apart = invert_rigid(scene.global_from_world @ first) @ again.global_from_world @ second
        assert float(apart[:3, 3].norm()) < 0.05
    for true, sweep in zip(by_lidar(scene), by_lidar(again), strict=True):
        places = [
            transform_points(one.global_from_world, one.read_column(part, "xyz_m").double())
            for one, part in ((scene, true), (again, sweep))
        ]
        assert float((places[0] - places[1]).norm(dim=1).max()) < 1e-3
    tracks = {track.actor_id: track for track in again.tracks}
    for true in scene.tracks:
        track = tracks[true.actor_id]
        apart_ns = (track.timestamps_ns - true.timestamps_ns).abs()
        assert int(apart_ns.max()) <= 500
        poses = again.global_from_world @ track.world_from_box
        apart_m = poses[:, :3, 3] - (scene.global_from_world @ true.world_from_box)[:, :3, 3]
        assert float(apart_m.norm(dim=1).max()) < 1e-3


def by_lidar(scene):
    return sorted(scene.sweeps, key=lambda sweep: (sweep.lidar_name, sweep.timestamp_ns))
