"""Every fault changes what it says in frames that train, and no image or sweep that judges."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from toy_store import write_toy_scene

from lidarpainter_models.errors import ConfigError
from lidarpainter_models.gaussians.model.corrections import CameraCorrections
from lidarpainter_models.scenes.driving_scene import DrivingScene
from lidarpainter_models.stress.causes import CAUSES
from lidarpainter_models.stress.frames import read_frame
from lidarpainter_models.stress.labels import clock_offset
from lidarpainter_models.stress.spoiling import write_spoilt
from lidarpainter_models.stress.sweeps import beams, kept, reach

TRAINS, JUDGES = 2, 1
"""Positions of frames; the first one holds the origin of the world."""


@pytest.fixture(scope="module")
def clean(tmp_path_factory):
    return DrivingScene.open(write_toy_scene(tmp_path_factory.mktemp("clean")))


@pytest.fixture
def spoilt(clean, tmp_path):
    def write(cause, level):
        return DrivingScene.open(write_spoilt(clean, cause, level, tmp_path))

    return write


def frame_of(scene, position):
    return read_frame(scene, scene.frame_indices[position])


def same(one, other):
    """Whether two frames hold the same, whatever it is stored as."""
    shots = [(s.jpeg, s.record.timestamp_ns, s.record.camera) for s in one.images]
    others = [(s.jpeg, s.record.timestamp_ns, s.record.camera) for s in other.images]
    cameras = len(shots) == len(others) and all(
        a[:2] == b[:2]
        and torch.equal(a[2].world_from_camera, b[2].world_from_camera)
        and a[2].fx_px == b[2].fx_px
        for a, b in zip(shots, others, strict=True)
    )
    points = len(one.sweeps) == len(other.sweeps) and all(
        torch.equal(a.points.xyz_m, b.points.xyz_m)
        for a, b in zip(one.sweeps, other.sweeps, strict=True)
    )
    boxes = [(b.actor_id, b.category, b.world_from_box.tolist()) for b in one.boxes]
    return (
        cameras
        and points
        and boxes == [(b.actor_id, b.category, b.world_from_box.tolist()) for b in other.boxes]
    )


@pytest.mark.parametrize("cause", sorted(CAUSES))
def test_a_fault_touches_no_image_or_sweep_that_judges(clean, spoilt, cause):
    level = CAUSES[cause].levels[-1]
    scene = spoilt(cause, level)
    judging, recorded = frame_of(scene, JUDGES), frame_of(clean, JUDGES)
    if CAUSES[cause].is_of_log:
        judging, recorded = (replace(frame, boxes=()) for frame in (judging, recorded))
        assert [shot.jpeg for shot in judging.images] == [shot.jpeg for shot in recorded.images]
        judging = replace(judging, images=recorded.images)
    assert same(judging, recorded)
    if cause not in ("swapped", "missing-cameras"):  # of one camera nothing can be
        assert not same(frame_of(scene, TRAINS), frame_of(clean, TRAINS))
    assert scene.manifest["stress"] == {
        "scene": clean.content_digest,
        "cause": cause,
        "level": level,
        "frames": "all" if CAUSES[cause].is_of_log else "training",
    }


def test_the_same_fault_is_the_same_scene(clean, tmp_path):
    digests = {
        DrivingScene.open(write_spoilt(clean, "dropout", 0.5, tmp_path / name)).content_digest
        for name in "ab"
    }
    assert len(digests) == 1


def test_a_cause_that_is_none_is_refused(clean, tmp_path):
    with pytest.raises(ConfigError, match="no cause 'rust', expected one of beams"):
        write_spoilt(clean, "rust", 1, tmp_path)
    assert not list(tmp_path.rglob("manifest.json"))


@pytest.mark.parametrize("share", [0.25, 0.75])
def test_so_many_returns_are_lost(clean, spoilt, share):
    before, after = (frame_of(one, TRAINS).sweeps[0] for one in (clean, spoilt("dropout", share)))
    left = after.points.num_points / before.points.num_points
    assert left == pytest.approx(1 - share, abs=0.05)


def test_nothing_returns_from_beyond_the_reach(spoilt):
    turn = frame_of(spoilt("reach", 10.0), TRAINS).sweeps[0]
    away_m = (turn.points.xyz_m - turn.world_from_lidar[:3, 3]).norm(dim=1)
    assert 0 < float(away_m.max()) <= 10.001


def test_beams_are_counted(clean, spoilt):
    before = frame_of(clean, TRAINS).sweeps[0].points.num_points
    counts = [frame_of(spoilt("beams", n), TRAINS).sweeps[0].points.num_points for n in (16, 4, 1)]
    assert before > counts[0] > counts[1] > counts[2] > 0
    assert frame_of(spoilt("beams", 0), TRAINS).sweeps == ()


def test_a_turn_that_keeps_no_point_goes(clean):
    frame, dice = frame_of(clean, TRAINS), np.random.default_rng(0)
    assert reach(frame, 0.0, dice).sweeps == ()  # no scene stores a sweep without points
    turn = frame.sweeps[0]
    nothing = torch.zeros(turn.points.num_points, dtype=torch.bool)
    assert beams(replace(frame, sweeps=(kept(turn, nothing),)), 4, dice).sweeps == ()


def test_drops_lie_between_the_sensor_and_what_it_saw(clean, spoilt):
    before, after = (frame_of(one, TRAINS).sweeps[0] for one in (clean, spoilt("clutter", 0.2)))
    origin = before.world_from_lidar[:3, 3].float()
    seen, found = ((t.points.xyz_m - origin).norm(dim=1) for t in (before, after))
    is_drop = (seen - found) > 1e-3
    assert float(is_drop.float().mean()) == pytest.approx(0.2, abs=0.04)
    assert float(found[is_drop].max()) <= 12.0


def test_a_pose_moves_all_that_the_car_saw(clean, spoilt):
    before, after = (frame_of(one, TRAINS) for one in (clean, spoilt("pose-noise", 0.3)))
    motion = after.world_from_ego @ torch.linalg.inv(before.world_from_ego)
    moved = motion @ before.images[0].record.camera.world_from_camera
    assert torch.allclose(after.images[0].record.camera.world_from_camera, moved)
    points = before.sweeps[0].points.xyz_m.double() @ motion[:3, :3].T + motion[:3, 3]
    assert torch.allclose(after.sweeps[0].points.xyz_m.double(), points, atol=1e-5)


def test_yaw_and_focal_length_are_as_stated(clean, spoilt):
    before = frame_of(clean, TRAINS).images[0].record.camera
    turned = frame_of(spoilt("camera-yaw", 2.0), TRAINS).images[0].record.camera
    ahead = [camera.world_from_camera[:3, 2] for camera in (before, turned)]
    assert float(torch.rad2deg(torch.arccos(ahead[0] @ ahead[1]))) == pytest.approx(2.0, rel=1e-6)
    right = before.world_from_camera[:3, 0]
    assert float(ahead[1] @ right) > 0
    longer = frame_of(spoilt("focal-length", 0.05), TRAINS).images[0].record.camera
    assert longer.fx_px == pytest.approx(1.05 * before.fx_px)


def test_a_camera_is_turned_in_frames_that_judge_as_in_those_that_train(clean, spoilt):
    """A fit that finds no turn, but for its noise, has judged cameras look where the others do."""
    scene = spoilt("camera-yaw", 1.0)
    views, held_out = scene.views[::2], scene.views[1::2]
    corrections = CameraCorrections.none(
        [view.key for view in views],
        torch.tensor([view.timestamp_ns for view in views]),
        torch.stack([view.camera.world_from_camera for view in views]),
    )
    noise = torch.randn(len(views), 6, generator=torch.Generator().manual_seed(0))
    corrections.view_tangent.copy_(1e-4 * noise)
    for view, before in zip(held_out, clean.views[1::2], strict=True):
        judged = corrections.refined(view.camera, view.key, view.timestamp_ns)
        apart = before.camera.world_from_camera[:3, 2] @ judged.world_from_camera[:3, 2]
        assert float(torch.rad2deg(torch.arccos(apart))) == pytest.approx(1.0, abs=0.03)


@pytest.mark.parametrize("position", [TRAINS, 3])
def test_a_late_clock_has_every_camera_stand_further_on(clean, position):
    frame = frame_of(clean, position)
    first, end_ns = frame_of(clean, 0), frame.log_end_ns

    def driven(time_ns):
        away = torch.eye(4).double()
        away[0, 3] = 3.0 * (min(time_ns, end_ns) - first.timestamp_ns) * 1e-9
        return away

    late = clock_offset(replace(frame, pose_at=driven), 100.0, np.random.default_rng(0))
    for shot, before in zip(late.images, frame.images, strict=True):
        way = shot.record.camera.world_from_camera - before.record.camera.world_from_camera
        assert float(way[0, 3]) == pytest.approx(0.3)
        assert shot.record.timestamp_ns == before.record.timestamp_ns + 100_000_000


def test_pictures_grow_dark_and_blurred(clean, spoilt):
    def pixels(scene):
        view = next(v for v in scene.views if v.frame_index == scene.frame_indices[TRAINS])
        return scene.read_image(view).numpy().astype(np.float64)

    before = pixels(clean)
    assert pixels(spoilt("darkness", 0.9)).mean() < 0.6 * before.mean()
    blurred = pixels(spoilt("motion-blur", 20))
    across = [np.abs(np.diff(image, axis=1)).max() for image in (before, blurred)]
    assert across[1] < 0.7 * across[0]


def test_a_level_that_so_few_cameras_do_not_have_is_left_out():
    assert CAUSES["swapped"].levels_of(6) == (1, 2, 3)
    assert CAUSES["missing-cameras"].levels_of(3) == (1, 2)
    assert CAUSES["missing-cameras"].levels_of(1) == ()
    assert CAUSES["beams"].levels_of(1) == CAUSES["beams"].levels


def test_a_tag_of_orientation_turns_no_image_that_is_spoilt(clean):
    shot = frame_of(clean, 1).images[0]
    # EXIF (TIFF, little-endian) with one entry: orientation 3, the image upside down
    entry = bytes.fromhex("1201 0300 01000000 03000000")
    exif = b"Exif\0\0II*\0" + bytes.fromhex("08000000 0100") + entry + bytes(4)
    tag = b"\xff\xe1" + (len(exif) + 2).to_bytes(2, "big") + exif
    turned = replace(shot, jpeg=shot.jpeg[:2] + tag + shot.jpeg[2:])
    as_seen = []
    for one in (shot, turned):
        one.with_pixels(lambda bgr: as_seen.append(bgr) or bgr)
    assert np.array_equal(*as_seen)
