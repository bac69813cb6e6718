"""The PandaSet reader on a small log of known geometry, and on the real one."""

import gzip
import pickle
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from pickled_tables import pickled_table
from small_pandaset import PandasetFolder

from lidarpainter_models.errors import DataError
from lidarpainter_models.geometry.boxes import is_inside_box
from lidarpainter_models.readers import ingest_scene
from lidarpainter_models.readers.pandaset.dataframe_pickle import read_table_bytes
from lidarpainter_models.readers.source_logs.log import read_ahead
from lidarpainter_models.scenes.driving_scene import DrivingScene
from lidarpainter_models.scenes.stored import stored_digest


def test_cameras_look_where_they_are_mounted(small_scene):
    forward = {
        name: small_scene.views_of(f"{name}_camera")[0].camera.world_from_camera[:3, 2]
        for name in ("front", "left", "back")
    }
    assert torch.allclose(forward["front"], torch.tensor([1.0, 0, 0]).double(), atol=1e-9)
    assert torch.allclose(forward["left"], torch.tensor([0, 1.0, 0]).double(), atol=1e-9)
    assert torch.allclose(forward["back"], torch.tensor([-1.0, 0, 0]).double(), atol=1e-9)


def test_camera_is_stored_where_the_log_says(small_scene):
    view = small_scene.view(2, "front_camera")
    stated = small_scene.image_record(view)
    expected = torch.tensor([2.0 - 0.5, 0.0, 1.8]).double()
    assert torch.allclose(stated.camera.centre_world, expected, atol=1e-5)
    assert abs(stated.timestamp_ns - int(small_scene.frame_timestamps_ns[2]) + 50_000_000) < 1000
    assert (view.camera.width_px, view.camera.height_px) == (64, 48)


def test_rows_are_read_from_30_ms_before_the_stated_time_to_10_ms_after(small_scene):
    view = small_scene.view(1, "front_camera")
    stated = small_scene.image_record(view)
    assert view.timestamp_ns == stated.timestamp_ns - 10_000_000
    assert view.camera.shutter.across_s == (0.0, 0.04)
    moved = view.camera.centre_world - stated.camera.centre_world
    assert moved.tolist() == pytest.approx([-0.1, 0.0, 0.0], abs=1e-4)  # at 10 m/s


def test_image_comes_back_as_the_bytes_of_the_log(small_scene, sound_pandaset):
    view = small_scene.view(1, "left_camera")
    file = sound_pandaset.path / "camera/left_camera/01.jpg"
    assert small_scene.read_jpeg(view) == file.read_bytes()
    assert small_scene.read_image(view).shape == (48, 64, 3)


@pytest.mark.parametrize("is_renamed", [False, True])
def test_tables_that_a_mirror_has_unpacked_are_read_alike(tmp_path, is_renamed):
    packed, unpacked = (PandasetFolder(tmp_path / name) for name in ("packed", "unpacked"))
    for log in (packed, unpacked):
        log.write_log()
    for file in unpacked.root.rglob("*.pkl.gz"):
        content = gzip.decompress(file.read_bytes())
        file.unlink()
        (file.with_suffix("") if is_renamed else file).write_bytes(content)
    first, second = (stored_digest(log.ingest(log.root / "s")) for log in (packed, unpacked))
    assert first == second


def test_points_keep_their_lidar_time_and_class(small_scene):
    sweeps = small_scene.sweeps_of(1)
    assert [sweep.lidar_name for sweep in sweeps] == ["pandar64", "pandar_gt"]
    points = small_scene.read_points(1)
    assert points.num_points == 25 * 25 + 3 * 60
    assert points.lidar.bincount().tolist() == [25 * 25 + 120, 60]
    assert small_scene.semantic_classes == {1: "Ground", 2: "Car"}
    assert small_scene.read_semantics(1).bincount().tolist() == [0, 625, 180]
    forward = small_scene.read_sweep(sweeps[1])
    assert forward.time_offset_ns.abs().max() < 1000  # all seen at one moment, up to float64
    assert points.xyz_m[:625, 2].sub(-0.3).abs().max() < 1e-5


def test_each_actor_is_one_track_with_length_along_x(small_scene):
    tracks = {track.actor_id: track for track in small_scene.tracks}
    assert set(tracks) == {"parked", "moving-0"}
    assert tracks["moving-0"].is_moving
    assert not tracks["parked"].is_moving
    for track in tracks.values():
        assert track.size_m.tolist() == pytest.approx([4.0, 2.0, 1.6])
        assert torch.allclose(
            track.world_from_box[:, :3, 0], torch.tensor([1.0, 0, 0]).double(), atol=1e-9
        )


def test_box_holds_when_its_lidar_saw_the_actor(small_scene):
    track = next(track for track in small_scene.tracks if track.is_moving)
    for view in small_scene.views_of("front_camera")[1:]:
        pose = track.pose_at(view.timestamp_ns)
        along_m = 12.0 + 8.0 * (0.1 * view.frame_index - 0.06)
        assert float(pose[0, 3]) == pytest.approx(along_m, abs=1e-4)


def test_points_of_both_lidars_lie_in_the_box_at_their_own_times(small_scene):
    track = next(track for track in small_scene.tracks if track.is_moving)
    for sweep in small_scene.sweeps_of(1):
        points = small_scene.read_sweep(sweep)
        moment_ns = sweep.timestamp_ns
        if sweep.lidar_name == "pandar64":
            moment_ns = int(track.timestamps_ns[1])
        inside = is_inside_box(points.xyz_m, track.pose_at(moment_ns), track.size_m)
        assert int(inside.sum()) == 60


def test_stated_number_of_points_is_that_inside_the_box(small_scene):
    track = next(track for track in small_scene.tracks if track.actor_id == "parked")
    assert track.num_points.tolist() == [60, 60, 60]


def test_frames_are_read_only_a_little_ahead():
    read = []

    def note(frame_index):
        read.append(frame_index)
        return frame_index

    with read_ahead(note, range(20)) as frames:
        for frame_index in frames:
            assert max(read) <= frame_index + 1
    assert read == list(range(20))


def test_error_in_a_frame_is_raised_when_the_frame_is_due():
    def refuse(frame_index):
        if frame_index == 1:
            raise DataError("frame 1")
        return frame_index

    with read_ahead(refuse, range(4)) as frames:
        assert next(frames) == 0
        with pytest.raises(DataError, match="frame 1"):
            next(frames)


def test_actor_seen_by_the_forward_lidar_alone_keeps_its_track(pandaset, tmp_path):
    place = {"centre": np.array([110.0, -40.0, 7.6])}
    box = {"uuid": "moving-1", "sensor": 1, "sibling": "moving-0", "stationary": False}
    pandaset.write_boxes(2, [{**box, **place}])
    scene = DrivingScene.open(pandaset.ingest(tmp_path))
    track = next(track for track in scene.tracks if track.actor_id == "moving-0")
    assert track.frame_indices.tolist() == [0, 1, 2]


def test_unlinked_twins_of_one_lidar_stay_two_actors(pandaset, tmp_path):
    box = {"sensor": 0, "sibling": "-", "stationary": False}
    for index in range(3):
        places = [np.array([110.0 + index, -40.0, 7.6]), np.array([110.0 + index, -36.0, 7.6])]
        boxes = [
            {**box, "uuid": name, "centre": place} for name, place in zip("ab", places, strict=True)
        ]
        pandaset.write_boxes(index, boxes)
    scene = DrivingScene.open(pandaset.ingest(tmp_path))
    assert [track.actor_id for track in scene.tracks] == ["a", "b"]


def test_standing_actor_marked_as_moving_is_part_of_the_street(pandaset, tmp_path):
    box = {"uuid": "person", "sensor": 0, "sibling": "-", "stationary": False}
    for index in range(3):
        place = np.array([110.0 + 0.02 * index, -40.0, 7.6])
        pandaset.write_boxes(index, [{**box, "centre": place}])
    scene = DrivingScene.open(pandaset.ingest(tmp_path))
    assert [track.is_moving for track in scene.tracks] == [False]


def test_log_without_point_classes_gives_a_scene_without(pandaset, tmp_path):
    shutil.rmtree(pandaset.path / "annotations/semseg")
    scene = DrivingScene.open(pandaset.ingest(tmp_path))
    assert scene.semantic_classes == {}
    assert scene.read_semantics(0) is None


COLUMNS = {
    "uuid": np.array(["a", None, "c"], dtype=object),
    "x": np.array([1.0, np.nan, 3.0]),
    "n": np.array([1, -2, 3]),
    "flag": np.array([True, False, True]),
    "y": np.array([4.0, 5.0, 6.0]),
    "small": np.array([4, 5, 6], dtype=np.uint8),
}


def require_columns(content):
    table = read_table_bytes(content, Path("table.pkl"))
    assert list(table) == list(COLUMNS)
    for name, column in COLUMNS.items():
        np.testing.assert_array_equal(table[name], column)


@pytest.mark.parametrize("as_pandas", [1, 2])
def test_tables_of_old_and_new_pandas_are_read(as_pandas):
    require_columns(pickled_table(COLUMNS, as_pandas=as_pandas))


@pytest.mark.parametrize("protocol", [2, 3, 4, 5])
def test_tables_of_todays_pandas_are_read_too(protocol):
    pandas = pytest.importorskip("pandas")
    names = pandas.Index(list(COLUMNS), dtype=object)
    series = {name: pandas.Series(value, dtype=value.dtype) for name, value in COLUMNS.items()}
    frame = pandas.DataFrame(series, columns=names)
    require_columns(pickle.dumps(frame, protocol=protocol))


@pytest.mark.slow
def test_real_log_becomes_a_scene(shared_folder, tmp_path):
    path = ingest_scene(
        *("pandaset", shared_folder / "data/pandaset", "002", tmp_path),
        frames=slice(0, 4),
        cameras=("front_camera",),
    )
    scene = DrivingScene.open(path)
    counts = scene.manifest["counts"]
    assert [counts[name] for name in ("frames", "images", "sweeps")] == [4, 4, 8]
    assert 90 <= counts["actors"] <= 95
    assert 160_000 < scene.read_points(0).num_points < 172_000
    assert 20 <= sum(track.is_moving for track in scene.tracks) <= 32


def test_real_pickles_are_those_of_pandas_1(shared_folder):
    file = shared_folder / "data/pandaset/002/annotations/cuboids/00.pkl.gz"
    assert b"0.14.1" in gzip.decompress(file.read_bytes())
    table = read_table_bytes(file.read_bytes(), file)
    assert len(table["uuid"]) == 118
    assert table["dimensions.y"].mean() > 2 * table["dimensions.x"].mean() * 0.9
