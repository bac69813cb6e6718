"""`export --format simulator`, `check-bundle` and `drive`, on the tiny street."""

import cv2
import numpy as np
import pytest
from bundle_reader import read_bundle, reference_line
from commands import refuse, succeed
from tiny_street import FRONT, NUM_FRAMES, SCENE, SIDE

from lidarpainter_models.geometry.transforms import interpolate_rigid_track
from tasks.opened import open_scene


@pytest.fixture(scope="module")
def bundle(tiny_run, tmp_path_factory):
    """The tiny run as a bundle, and what the command said."""
    path = tmp_path_factory.mktemp("bundle") / "street.usdz"
    words = ("export", tiny_run.run_id, "--format", "simulator", "--out", path, "--json")
    made = succeed(*words, store=tiny_run.store).json
    assert made["path"] == str(path)
    return path, made


def test_a_reader_that_is_not_ours_finds_the_log_in_the_bundle(tiny_run, bundle):
    path, made = bundle
    read, scene = read_bundle(path), open_scene(tiny_run.store, SCENE)
    assert all(start % 64 == 0 for start in read.starts)
    assert read.metadata["scene_id"] == SCENE
    assert read.metadata["logger"]["run_id"] == tiny_run.run_id
    finished = tiny_run.store.run(tiny_run.run_id)["finished_at"]
    assert read.metadata["training_date"] == finished.date().isoformat()
    assert read.metadata["dataset_hash"] == scene.content_digest
    assert set(read.metadata["sensors"]["camera_ids"]) == {FRONT, SIDE}
    outputs = read.metadata["training_step_outputs"]
    assert {"envelope_left_m", "envelope_right_m", "envelope_000_from_m"} <= set(outputs)
    assert all(isinstance(value, float) for value in outputs.values())
    (rig,) = read.rig["rig_trajectories"]
    times_us = rig["T_rig_world_timestamps_us"]
    assert len(times_us) == len(rig["T_rig_worlds"]) >= NUM_FRAMES
    for spans in rig["cameras_frame_timestamps_us"].values():
        assert len(spans) == NUM_FRAMES
        assert all(times_us[0] <= start < end <= times_us[-1] for start, end in spans)
    moving = [track.actor_id for track in scene.tracks if track.is_moving]
    flags = dict(
        zip(
            read.tracks["tracks_data"]["tracks_id"],
            read.tracks["tracks_data"]["tracks_flags"],
            strict=True,
        )
    )
    assert {name for name, flag in flags.items() if flag == "CONTROLLABLE"} <= set(moving)
    assert made["num_actors"] == len([flag for flag in flags.values() if flag == "CONTROLLABLE"])


def test_cameras_stand_where_the_log_has_them(tiny_run, bundle):
    read, scene = read_bundle(bundle[0]), open_scene(tiny_run.store, SCENE)
    rig_from_camera = {
        one["logical_sensor_name"]: np.array(one["T_sensor_rig"])
        for one in read.rig["camera_calibrations"].values()
    }
    for view in scene.views:
        ego = interpolate_rigid_track(
            scene.frame_timestamps_ns, scene.world_from_ego, view.timestamp_ns
        ).numpy()
        there = ego @ rig_from_camera[view.camera_name]
        np.testing.assert_allclose(
            there[:3, 3], view.camera.world_from_camera[:3, 3].numpy(), atol=0.1
        )


def test_the_ground_lies_below_the_path_and_the_map_along_it(tiny_run, bundle):
    read, scene = read_bundle(bundle[0]), open_scene(tiny_run.store, SCENE)
    path_m = scene.world_from_ego[:, :3, 3].numpy()
    vertices, faces = read.meshes["mesh_ground.ply"]
    assert faces.max() < len(vertices)
    for place in path_m:
        near = np.linalg.norm(vertices[:, :2] - place[:2], axis=1) < 0.5
        assert np.abs(vertices[near, 2] - place[2]).max() < 0.1  # the street's ego is on the road
    assert len(read.meshes["mesh.ply"][0]) >= len(vertices)
    line = reference_line(read.road)
    right = read.road.find("road/lanes/laneSection/right")
    width_m = sum(float(lane.find("width").get("a")) for lane in right)
    for place in path_m:  # the driven lane is right of the reference line
        away = place[:2] - line[:, 1:3]
        nearest = np.linalg.norm(away, axis=1).argmin()
        along = line[min(nearest + 1, len(line) - 1), 1:3] - line[nearest - 1, 1:3]
        to_right = along[1] * away[nearest, 0] - along[0] * away[nearest, 1]
        assert 0 < to_right / np.linalg.norm(along) < width_m


def test_usd_core_opens_the_bundle_as_it_is(bundle):
    from pxr import Usd

    stage = Usd.Stage.Open(str(bundle[0]))
    kinds = [prim.GetTypeName() for prim in stage.Traverse()]
    assert kinds.count("ParticleField3DGaussianSplat") >= 1


def test_check_bundle_finds_nothing_that_fails(bundle):
    told = succeed("check-bundle", bundle[0], "--json").json
    assert told["is_fit"]
    verdicts = {one["name"]: one["verdict"] for one in told["findings"]}
    assert set(verdicts) == {"layer", "metadata", "rig", "tracks", "meshes", "map"}
    assert "what" in succeed("check-bundle", bundle[0]).out


def test_drive_goes_through_the_server_and_writes_a_film(tiny_run, tmp_path):
    script = tmp_path / "mine.py"
    script.write_text(
        "def drive(seen):\n"
        "    assert seen.images and all(image.ndim == 3 for image in seen.images.values())\n"
        "    return seen.recorded_speed_mps - seen.speed_mps, 0.0\n"
    )
    words = ("drive", tiny_run.run_id, "--policy", script, "--seconds", "0.3", "--width", "64")
    told = succeed(*words, "--out", tmp_path / "d", "--json", store=tiny_run.store).json
    assert told["seconds"] == pytest.approx(0.3)
    assert told["frames"] == 4 * 2
    assert 0 <= told["trusted_share"] <= 1
    assert told["off_road_s"] == 0
    film = cv2.VideoCapture(told["film"])
    assert int(film.get(cv2.CAP_PROP_FRAME_COUNT)) == 4
    assert [path.name for path in (tmp_path / "d").iterdir()] == ["drive.mp4"]


def test_wrong_words_of_a_drive_are_refused(tiny_run, tmp_path, monkeypatch):
    monkeypatch.setattr("lidarpainter_models.serving.sensor_client.CONNECT_S", 0.3)
    drive = ("drive", tiny_run.run_id, "--out", tmp_path / "d")
    for words, complaint in (
        (("--policy", "fast"), "expected lane-keep, log, idm or a .py file"),
        (("--against", "nowhere"), "expected HOST:PORT"),
        (("--lane-change", "99"), "expected at most 20 m"),
        (("--seconds", "99"), "as long as the log is"),
        (("--against", "127.0.0.1:1", "--seconds", "0.2"), "127.0.0.1:1: "),
    ):
        assert complaint in refuse(*drive, *words, store=tiny_run.store)
    assert not (tmp_path / "d" / "drive.mp4").exists()
