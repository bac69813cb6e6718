"""What becomes a frame, which image and which boxes it gets, and when points were measured."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from nuscenes_log import SCENE_NAME, write_nuscenes_log

from lidarpainter_models.readers import ingest_scene, list_sequences
from lidarpainter_models.readers.nuscenes import dataset as nuscenes_dataset
from lidarpainter_models.readers.nuscenes.sweeps import TURN_NS, read_lidar_points, turn_offset_ns
from lidarpainter_models.readers.source_logs.folder import SourceFolder
from lidarpainter_models.scenes.driving_scene import DrivingScene

US = 1_000


def test_turn_goes_from_the_left_clockwise():
    x_m, y_m = np.array([[-5.0, 0, 5, 0, -4], [0.0, 5, 0, -5, -0.001]])
    quarters_ns = turn_offset_ns(x_m, y_m)
    assert quarters_ns[:4].tolist() == [-50_000_000, -37_500_000, -25_000_000, -12_500_000]
    assert -10_000 < quarters_ns[4] < 0


def written_sweep(folder, azimuth_rad):
    rows = np.zeros((len(azimuth_rad), 5), "<f4")
    rows[:, 0], rows[:, 1] = 10 * np.cos(azimuth_rad), 10 * np.sin(azimuth_rad)
    (folder / "sweep.pcd.bin").write_bytes(rows.tobytes())
    return read_lidar_points(SourceFolder(folder), "sweep.pcd.bin")


def test_order_of_firing_decides_on_which_side_of_the_seam_a_point_is(tmp_path):
    turned = np.linspace(-0.01, 1.01, 500)  # begins before the left, ends beyond it
    offset_ns = written_sweep(tmp_path, np.pi - 2 * np.pi * turned).time_offset_ns
    np.testing.assert_allclose(offset_ns, (turned - 1) * TURN_NS, atol=2 * US)


def test_points_in_any_order_have_the_time_of_their_azimuth(tmp_path):
    turned = np.random.default_rng(0).uniform(0.02, 0.98, 500)
    offset_ns = written_sweep(tmp_path, np.pi - 2 * np.pi * turned).time_offset_ns
    np.testing.assert_allclose(offset_ns, (turned - 1) * TURN_NS, atol=2 * US)


def test_times_of_a_scene_lie_within_the_turn(read_street):
    for sweep in read_street.sweeps:
        offset_ns = read_street.read_sweep(sweep).time_offset_ns
        assert offset_ns.abs().max() <= TURN_NS // 2
        frame = read_street.frame_position(sweep.frame_index)
        assert read_street.frame_timestamps_ns[frame] - sweep.timestamp_ns == TURN_NS // 2


def test_boxes_end_with_the_last_key_frame(small_street, tmp_path):
    write_nuscenes_log(small_street, tmp_path / "log", key_every=2)  # sweeps 0 and 2 of 0 to 3
    scene = DrivingScene.open(ingest_scene("nuscenes", tmp_path / "log", SCENE_NAME, tmp_path))
    assert {tuple(track.frame_indices.tolist()) for track in scene.tracks} == {(0, 1, 2)}


def test_instance_missing_at_a_key_frame_has_no_boxes_around_it(small_street, tmp_path):
    gone = small_street.tracks[0].actor_id
    root = tmp_path / "log"
    write_nuscenes_log(small_street, root, key_every=1)
    path = root / "v1.0-mini/sample_annotation.json"
    rows = json.loads(path.read_text())
    own = [row for row in rows if row["instance_token"] == gone]
    path.write_text(json.dumps([row for row in rows if row["token"] != own[1]["token"]]))
    data = root / "v1.0-mini/sample_data.json"
    assert len(json.loads(data.read_text())) > 8
    scene = DrivingScene.open(ingest_scene("nuscenes", root, SCENE_NAME, tmp_path))
    track = next(track for track in scene.tracks if track.actor_id == gone)
    assert track.frame_indices.tolist() == [0, 2, 3]


def test_sweeps_without_a_image_are_frames_too(log, store):
    dropped = log.rows_of("CAM_FRONT")[1]["token"]
    log.edit("sample_data", lambda rows: [row for row in rows if row["token"] != dropped])
    scene = log.read(store)
    assert scene.frame_indices == (0, 1, 2, 3)
    assert [view.frame_index for view in scene.views_of("CAM_FRONT")] == [0, 2, 3]


def shift_image(log, position, shift_us):
    """Take an image of the front camera at another time; the front is seen 37.5 ms before."""
    token = log.rows_of("CAM_FRONT")[position]["token"]

    def change(rows):
        sweep_us = log.rows_of("LIDAR_TOP")[position]["timestamp"]
        for row in rows:
            if row["token"] == token:
                row["timestamp"] = sweep_us - 37_500 + shift_us

    log.edit("sample_data", change)


@pytest.mark.parametrize(("shift_us", "frames"), [(-24_000, [0, 1, 2, 3]), (24_000, [0, 1, 2, 3])])
def test_image_belongs_to_the_sweep_that_looked_there_nearest(log, store, shift_us, frames):
    shift_image(log, 1, shift_us)
    scene = log.read(store)
    assert [view.frame_index for view in scene.views_of("CAM_FRONT")] == frames


def test_of_two_images_a_sweep_keeps_the_nearer(log, store):
    shift_image(log, 1, 30_000)  # nearer to sweep 2, which has one at 12.5 ms
    scene = log.read(store)
    assert [view.frame_index for view in scene.views_of("CAM_FRONT")] == [0, 2, 3]
    kept_ns = scene.view(2, "CAM_FRONT").timestamp_ns
    assert kept_ns == log.rows_of("CAM_FRONT")[2]["timestamp"] * US


def test_image_that_no_sweep_is_near_to_is_left_out(log, store):
    lost = [row["token"] for row in log.rows_of("LIDAR_TOP")[1:3]]
    log.edit("sample_data", lambda rows: [row for row in rows if row["token"] not in lost])
    scene = log.read(store)
    assert len(scene.frame_indices) == 2
    assert [view.frame_index for view in scene.views_of("CAM_FRONT")] == [0, 1]


def test_image_of_a_key_frame_belongs_to_its_sweep_however_late(log, store):
    shift_image(log, 3, 60_000)
    assert log.read(store).view(3, "CAM_FRONT").frame_index == 3


def test_scene_without_boxes_is_a_scene(log, store):
    """As v1.0-test is published."""
    log.edit("sample_annotation", lambda rows: rows.clear())
    log.edit("instance", lambda rows: rows.clear())
    assert log.read(store).tracks == ()


def test_cycles_of_prev_and_next_change_nothing(log, sound_log, store, tmp_path):
    def tie(rows):
        for row in rows:
            row["prev"] = row["next"] = row["token"]

    for table in ("sample", "sample_data", "sample_annotation"):
        log.edit(table, tie)
    sound = sound_log.read(tmp_path / "other")
    assert log.read(store).content_digest == sound.content_digest


def test_licence_version_and_digests_are_noted(log, store):
    scene = log.read(store)
    assert scene.manifest["licence"].startswith("CC BY-NC-SA 4.0")
    provenance = scene.manifest["provenance"]
    assert provenance["version"] == "v1.0-mini"
    assert provenance["num_files"] == 4 + 8
    assert len(provenance["tables_sha256"]["sample_data"]) == 64


def test_scenes_of_all_versions_are_listed_and_the_fullest_is_read(log, store):
    shutil.copytree(log.folder, log.root / "v1.0-trainval")
    log.edit("scene", lambda rows: [*rows, {**rows[0], "name": "scene-0103"}])
    assert list_sequences("nuscenes", log.root) == (SCENE_NAME, "scene-0103")
    assert log.read(store).manifest["provenance"]["version"] == "v1.0-trainval"


def test_tables_are_read_once_for_all_sequences_and_anew_when_changed(log, tmp_path, monkeypatch):
    read = []

    class Counting(nuscenes_dataset.NuscenesTable):
        def __init__(self, path, key):
            read.append(Path(path).stem)
            super().__init__(path, key)

    monkeypatch.setattr(nuscenes_dataset, "NuscenesTable", Counting)
    for number in range(3):
        log.ingest(tmp_path / f"store-{number}")
    assert sorted(read) == sorted(set(read))
    assert {"sample_data", "sample_annotation", "ego_pose"} <= set(read)
    log.edit("category", lambda rows: [{**row, "description": "changed"} for row in rows])
    read.clear()
    log.ingest(tmp_path / "store-last")
    assert read == ["category"]
