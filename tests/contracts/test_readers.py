"""What every reader keeps to, whatever its dataset's oddities are."""

import copy
from functools import cache

import pytest
import torch
from scene_differences import scene_differences
from written_logs import WRITERS

from lidarpainter_models.errors import DataError, LidarPainterError
from lidarpainter_models.geometry.transforms import is_rigid
from lidarpainter_models.readers import ingest_scene, known_datasets, list_sequences
from lidarpainter_models.scenes.driving_scene import DrivingScene

NUMBERS_OF_A_LOG_M = 1e-3
"""Logs state poses far from their origin: two ways through them differ in the last digits."""


def test_every_reader_is_held_to_the_contract():
    assert {name.split(",")[0] for name in WRITERS} == set(known_datasets())


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """Every log is written and read once for all tests."""

    @cache
    def make(name):
        log = WRITERS[name](tmp_path_factory.mktemp("log"))
        return log, log.read(tmp_path_factory.mktemp("store"))

    return make


@pytest.fixture(params=WRITERS)
def log_and_scene(request, written):
    return written(request.param)


@pytest.fixture
def log(log_and_scene):
    return log_and_scene[0]


@pytest.fixture
def scene(log_and_scene):
    return log_and_scene[1]


def refused_line(ingest, store):
    """The one line of a refusal, which leaves no file in the store."""
    with pytest.raises(LidarPainterError) as raised:
        ingest()
    assert [path for path in store.rglob("*") if path.is_file()] == []
    line = str(raised.value)
    assert "\n" not in line
    return line


def test_a_sequence_on_disk_is_found(log):
    assert list_sequences(log.dataset, log.root) == (log.sequence,)


def test_every_frame_has_what_the_others_stand_on(scene):
    assert list(scene.frame_indices) == sorted(set(scene.frame_indices))
    assert bool((scene.frame_timestamps_ns[1:] > scene.frame_timestamps_ns[:-1]).all())
    assert {view.frame_index for view in scene.views} <= set(scene.frame_indices)
    assert {view.camera_name for view in scene.views} == set(scene.camera_names)
    for frame in scene.frame_indices:
        points = scene.read_points(frame)
        assert len(points.xyz_m) == sum(sweep.num_points for sweep in scene.sweeps_of(frame)) > 0
        assert bool(points.xyz_m.isfinite().all())
    for view in scene.views:
        image = scene.read_image(view)
        assert image.shape == (view.camera.height_px, view.camera.width_px, 3)
        assert image.float().std() > 1


def test_world_begins_at_the_first_ego_pose_and_every_pose_is_rigid(scene):
    assert torch.allclose(scene.world_from_ego[0, :3, 3], torch.zeros(3).double(), atol=1e-6)
    poses = [
        scene.global_from_world,
        *scene.world_from_ego,
        *(view.camera.world_from_camera for view in scene.views),
        *(sweep.world_from_lidar for sweep in scene.sweeps),
        *(pose for track in scene.tracks for pose in track.world_from_box),
    ]
    assert all(bool(is_rigid(pose)) for pose in poses)


def test_a_written_scene_passes_every_check_of_the_format(scene, tmp_path):
    """The canonical reader trusts nothing: tables, arrays, digests, images and times."""
    path = ingest_scene("canonical", scene.path.parent, scene.sequence, tmp_path)
    assert DrivingScene.open(path).content_digest == scene.content_digest


def test_content_depends_on_the_log_alone_and_not_on_where_it_lies(log, scene, tmp_path):
    again = log.copied(tmp_path / "moved").read(tmp_path / "store")
    assert again.content_digest == scene.content_digest
    assert scene.manifest["licence"]


def test_part_of_a_log_is_the_same_part_of_the_whole(log, scene, tmp_path):
    camera = scene.camera_names[-1]
    part = log.read(tmp_path, frames=slice(1, 2), cameras=(camera,))
    chosen = scene.frame_indices[1:2]
    assert part.frame_indices == chosen
    assert part.camera_names == (camera,)
    whole = copy.copy(scene)
    whole.views = scene.views_of(camera)
    found = scene_differences(whole, part, frames=[(frame, frame) for frame in chosen])
    assert found.num_other_images == 0
    assert found.intrinsics == 0
    assert found.camera_centre_m < NUMBERS_OF_A_LOG_M
    assert found.camera_rotation_deg < 1e-4
    assert found.point_m < NUMBERS_OF_A_LOG_M
    assert found.num_unpaired_boxes == 0
    assert found.box_centre_m < NUMBERS_OF_A_LOG_M


def test_what_a_log_does_not_hold_is_refused_in_one_line(log, tmp_path):
    for options, expected in (
        ({"cameras": ("no such camera",)}, "no camera 'no such camera', expected some of"),
        ({"frames": slice(70, 90)}, "select none of its"),
    ):
        assert expected in refused_line(lambda o=options: log.ingest(tmp_path, **o), tmp_path)


@pytest.mark.parametrize("sequence", ["../x", "..", "/etc", "", "a/b", "absent"])
def test_sequence_that_is_not_there_or_leaves_the_store_is_refused(log, tmp_path, sequence):
    line = refused_line(lambda: ingest_scene(log.dataset, log.root, sequence, tmp_path), tmp_path)
    assert sequence in line


def test_root_without_a_log_is_refused(log, tmp_path):
    with pytest.raises(DataError, match="no such folder"):
        list_sequences(log.dataset, tmp_path / "gone")
    with pytest.raises(DataError, match=f"no {log.dataset} sequence found"):
        list_sequences(log.dataset, tmp_path)


def test_a_missing_file_is_refused_in_one_line_unless_nothing_is_read_from_it(log, scene, tmp_path):
    num_refused = 0
    files = [file for file in log.files() if log.is_listed(file)]
    for number, file in enumerate(files[:: max(len(files) // 5, 1)]):
        damaged = log.copied(tmp_path / f"log-{number}")
        (damaged.root / file.relative_to(log.root)).unlink()
        store = tmp_path / f"store-{number}"
        try:
            digest = damaged.read(store).content_digest
        except LidarPainterError:
            refused_line(lambda d=damaged, s=store: d.ingest(s), store)
            num_refused += 1
        else:
            assert digest == scene.content_digest
    assert num_refused > 0


def test_progress_is_told_after_every_frame(log, scene, tmp_path):
    told = []
    log.ingest(tmp_path, progress=lambda done, total: told.append((done, total)))
    total = len(scene.frame_indices)
    assert told == [(done, total) for done in range(1, total + 1)]
