"""A stored scene is read back exactly, and refused when anything of it is missing."""

import json
import shutil

import pytest
import torch
import zarr

from lidarpainter_models.errors import SceneError
from lidarpainter_models.geometry.transforms import is_rigid
from lidarpainter_models.scenes.driving_scene import DrivingScene
from lidarpainter_models.scenes.stored import stored_digest


@pytest.fixture
def copied_scene(small_scene, tmp_path):
    """A copy that a test may damage."""
    path = tmp_path / "scene"
    shutil.copytree(small_scene.path, path)
    return path


def test_poses_come_back_as_float64(small_scene):
    poses = [small_scene.world_from_ego, *(track.world_from_box for track in small_scene.tracks)]
    poses += [sweep.world_from_lidar for sweep in small_scene.sweeps]
    assert all(pose.dtype == torch.float64 and bool(is_rigid(pose).all()) for pose in poses)


def test_whole_content_is_what_was_written_until_one_number_changes(copied_scene):
    DrivingScene.open(copied_scene).verify_content()
    array = zarr.open_array(copied_scene / "scene.zarr/point_intensity", mode="r+")
    array[0] = array[0] + 1
    manifest = json.loads((copied_scene / "manifest.json").read_text())
    for name in manifest["files"]:  # as if the file had always been so
        manifest["files"][name] = (copied_scene / name).stat().st_size
    (copied_scene / "manifest.json").write_text(json.dumps(manifest))
    with pytest.raises(SceneError, match="array point_intensity is not what was written"):
        DrivingScene.open(copied_scene).verify_content()


def test_asking_for_what_is_not_there_names_what_is(small_scene):
    with pytest.raises(SceneError, match="no camera 'top'; it has front_camera"):
        small_scene.views_of("top")
    with pytest.raises(SceneError, match="no frame 9; frames go from 0 to 2"):
        small_scene.frame_position(9)
    with pytest.raises(SceneError, match="frame 9 has no LiDAR sweep"):
        small_scene.read_points(9)


def test_folder_without_a_manifest_is_no_scene(tmp_path):
    with pytest.raises(SceneError, match="no scene here"):
        DrivingScene.open(tmp_path)
    assert stored_digest(tmp_path) is None


@pytest.mark.parametrize("name", ["cameras.parquet", "scene.zarr/point_xyz_m/c/0/0"])
def test_missing_file_is_noticed_on_opening(copied_scene, name):
    (copied_scene / name).unlink()
    with pytest.raises(SceneError, match=r"missing; the scene is damaged, ingest it again"):
        DrivingScene.open(copied_scene)


def test_shortened_file_is_noticed_on_opening(copied_scene):
    file = copied_scene / "scene.zarr/image_bytes/c/0"
    file.write_bytes(file.read_bytes()[:-5])
    with pytest.raises(SceneError, match="the scene is damaged"):
        DrivingScene.open(copied_scene)


def test_flipped_byte_is_noticed_on_reading(copied_scene):
    file = copied_scene / "scene.zarr/point_xyz_m/c/0/0"
    content = bytearray(file.read_bytes())
    content[len(content) // 2] ^= 1
    file.write_bytes(content)
    scene = DrivingScene.open(copied_scene)
    with pytest.raises(SceneError, match="array point_xyz_m cannot be read"):
        scene.read_points(0)


def test_changed_table_is_noticed_by_the_digest(copied_scene):
    manifest = json.loads((copied_scene / "manifest.json").read_text())
    manifest["tables"]["boxes"]["sha256"] = "0" * 64
    (copied_scene / "manifest.json").write_text(json.dumps(manifest))
    with pytest.raises(SceneError, match="table boxes is not what was written"):
        DrivingScene.open(copied_scene).verify_content()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"is_complete": False}, "not complete"),
        ({"schema_version": 99}, "schema version 99, expected 2"),
    ],
)
def test_unfinished_or_foreign_manifest_is_refused(copied_scene, change, message):
    manifest = json.loads((copied_scene / "manifest.json").read_text())
    (copied_scene / "manifest.json").write_text(json.dumps({**manifest, **change}))
    with pytest.raises(SceneError, match=message):
        DrivingScene.open(copied_scene)


def test_manifest_that_is_no_json_is_refused(copied_scene):
    (copied_scene / "manifest.json").write_text("{")
    with pytest.raises(SceneError, match="cannot be read"):
        DrivingScene.open(copied_scene)


def test_track_pose_is_interpolated_and_holds_beyond_its_ends(small_scene):
    track = next(track for track in small_scene.tracks if track.is_moving)
    first_ns, second_ns = track.timestamps_ns[:2].tolist()
    middle = track.pose_at((first_ns + second_ns) // 2)
    expected = (track.world_from_box[0] + track.world_from_box[1]) / 2
    assert torch.allclose(middle[:3, 3], expected[:3, 3], atol=1e-6)
    assert torch.equal(track.pose_at(first_ns - 10**9), track.world_from_box[0])
    assert track.is_present(first_ns - 40_000_000)
    assert not track.is_present(first_ns - 60_000_000)
