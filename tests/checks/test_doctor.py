"""Each way to get a scene wrong is found by the check that looks for it."""

import json
import shutil
from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
import torch

from lidarpainter_models.checks import actors
from lidarpainter_models.checks.actors import check_box_axes, check_duplicate_tracks
from lidarpainter_models.checks.doctor import check_ego_poses, check_scene, draw_overlay
from lidarpainter_models.scenes.driving_scene import DrivingScene


def verdicts(scene):
    return {check.name: check.verdict for check in check_scene(scene)}


def edit_json(log, name, change):
    value = json.loads((log.path / name).read_text())
    change(value)
    (log.path / name).write_text(json.dumps(value))


def ingested(log, tmp_path, **options):
    return DrivingScene.open(log.ingest(tmp_path / "store", **options))


def finding(scene, name):
    return next(check for check in check_scene(scene) if check.name == name)


def test_sound_scene_passes_every_check(small_scene):
    checks = check_scene(small_scene)
    assert [check for check in checks if check.verdict != "ok"] == []
    assert len({check.name for check in checks}) == 16


@pytest.fixture
def scene(small_scene):
    """The small scene, of which a test may change what was read."""
    return DrivingScene.open(small_scene.path)


def change_views(scene, camera_name, change):
    """Replace the views of one camera; `change` takes a view and its position among them."""
    views = iter([change(view, row) for row, view in enumerate(scene.views_of(camera_name))])
    scene.views = tuple(
        next(views) if view.camera_name == camera_name else view for view in scene.views
    )


def test_jump_of_the_car_is_found(scene):
    scene.world_from_ego[2, 0, 3] = 500.0
    check = finding(scene, "ego poses")
    assert check.verdict == "fail"
    assert "a jump at frame 2" in check.detail


def test_turn_of_the_car_on_the_spot_is_found_where_it_is(scene):
    half_turn = torch.diag(torch.tensor([-1.0, -1, 1, 1], dtype=torch.float64))
    scene.world_from_ego[2] = scene.world_from_ego[1] @ half_turn
    verdict, detail = check_ego_poses(scene)
    assert verdict == "fail"
    assert "a jump at frame 2" in detail


def test_ego_whose_x_is_not_forward_is_found(scene):
    across = torch.tensor(
        [[0.0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]], dtype=torch.float64
    )
    scene.world_from_ego = scene.world_from_ego @ across
    check = finding(scene, "ego poses")
    assert check.verdict == "fail"
    assert "drives across its x axis: is ego x forward, y left?" in check.detail
    scene.world_from_ego = scene.world_from_ego @ across  # backwards is a way to drive
    assert check_ego_poses(scene)[0] == "ok"


def test_camera_clock_off_by_half_a_second_is_found(scene):
    change_views(
        scene,
        "left_camera",
        lambda view, _: replace(view, timestamp_ns=view.timestamp_ns + 500_000_000),
    )
    assert finding(scene, "camera sync").verdict == "fail"


def test_camera_times_that_run_backwards_are_found(scene):
    times_ns = [view.timestamp_ns for view in scene.views_of("left_camera")][::-1]
    change_views(scene, "left_camera", lambda view, row: replace(view, timestamp_ns=times_ns[row]))
    assert finding(scene, "timestamps").verdict == "fail"


def test_camera_that_leaves_its_mount_is_found(pandaset, tmp_path):
    move = {"x": 103.0, "y": -47.0}
    edit_json(
        pandaset, "camera/back_camera/poses.json", lambda poses: poses[1]["position"].update(move)
    )
    assert verdicts(ingested(pandaset, tmp_path))["camera rig"] == "warn"


def test_images_after_the_last_pose_of_the_car_say_nothing_of_the_mount(scene):
    last_ns = int(scene.frame_timestamps_ns[-1])

    def late(view, row):
        if row < len(scene.frame_indices) - 1:
            return view
        further = view.camera.world_from_camera.clone()
        further[0, 3] += 1.0
        return replace(view, timestamp_ns=last_ns + 100_000_000, camera=view.camera.at(further))

    change_views(scene, "right_camera", late)
    assert finding(scene, "camera rig").verdict == "ok"


def test_camera_that_looks_into_the_sky_is_found(scene):
    def look_up(view, _row):
        pose = view.camera.world_from_camera.clone()
        pose[:3, :3] = torch.eye(3)
        return replace(view, camera=replace(view.camera, world_from_camera=pose))

    change_views(scene, "right_camera", look_up)
    check = finding(scene, "points in images")
    assert check.verdict == "fail"
    assert "right_camera 0%" in check.detail


def moved_points(log, index, change):
    """Rewrite one frame's points with their positions changed."""
    name = f"lidar/{index:02d}.pkl.gz"
    table = log.read_table(name)
    xyz_m = change(np.stack([table[axis] for axis in "xyz"], axis=1))
    log.write_table(name, {**table, **dict(zip("xyz", xyz_m.T, strict=True))})


def test_sweep_that_lies_beside_the_others_is_found(pandaset, tmp_path):
    moved_points(pandaset, 1, lambda xyz_m: xyz_m + np.array([0.4, 0.4, 0.3]))
    assert verdicts(ingested(pandaset, tmp_path))["sweeps agree"] == "fail"


def test_ground_that_stands_on_edge_is_found(pandaset, tmp_path):
    for index in range(3):
        moved_points(
            pandaset, index, lambda xyz_m: xyz_m + 0.3 * (xyz_m[:, :1] - 100.0) * [[0, 0, 1]]
        )
    assert verdicts(ingested(pandaset, tmp_path))["ground"] == "fail"


def change_boxes(log, change):
    for index, time_s in enumerate(log.frame_times_s()):
        log.write_boxes(index, [change(box) for box in log.boxes_at(time_s)])


def test_boxes_beside_their_cars_are_found(pandaset, tmp_path):
    change_boxes(pandaset, lambda box: {**box, "centre": box["centre"] + [3.0, -3.0, 0.0]})
    assert verdicts(ingested(pandaset, tmp_path))["boxes hold points"] == "fail"


def test_boxes_that_drive_sideways_are_found(pandaset, tmp_path):
    change_boxes(pandaset, lambda box: {**box, "yaw_deg": 45.0})
    assert verdicts(ingested(pandaset, tmp_path))["boxes point ahead"] == "fail"


def test_some_turned_boxes_are_no_wrong_convention(pandaset, tmp_path):
    for index, time_s in enumerate(pandaset.frame_times_s()[1:], start=1):
        boxes = pandaset.boxes_at(time_s)
        pandaset.write_boxes(index, [{**box, "yaw_deg": 45.0} for box in boxes])
    assert verdicts(ingested(pandaset, tmp_path))["boxes point ahead"] == "warn"


def test_one_step_aside_is_no_wrong_convention(scene):
    def moved_aside(num_boxes):
        track = next(track for track in scene.tracks if track.is_moving)
        boxes = track.world_from_box[:1].repeat(num_boxes, 1, 1)
        boxes[:, :3, 3] += 2.0 * torch.arange(num_boxes)[:, None] * boxes[:, :3, 1]
        rows = dict.fromkeys(
            ("frame_indices", "timestamps_ns", "num_points"), torch.arange(num_boxes)
        )
        scene.tracks = (replace(track, world_from_box=boxes, **rows),)
        return check_box_axes(scene)[0]

    assert moved_aside(2) == "warn"
    assert moved_aside(3) == "fail"


def test_actor_with_two_tracks_is_found(pandaset, tmp_path):
    change_boxes(pandaset, lambda box: {**box, "sibling": "-"})
    scene = ingested(pandaset, tmp_path)
    check = next(check for check in check_scene(scene) if check.name == "duplicate tracks")
    assert check.verdict == "warn"
    assert "moving-1 = moving-0" in check.detail


def random_tracks(track, num_tracks):
    """Cars in one to four of four frames, in places where some pairs meet in none or a few."""
    random = np.random.default_rng(0)
    for number in range(num_tracks):
        frames = torch.tensor(np.sort(random.permutation(4)[: random.integers(1, 5)]))
        poses = torch.eye(4, dtype=torch.float64).repeat(len(frames), 1, 1)
        centres_m = random.uniform(0, 20, 2) + random.normal(0, 0.7, (len(frames), 2))
        poses[:, :2, 3] = torch.from_numpy(centres_m)
        yield replace(
            track,
            actor_id=f"car-{number}",
            size_m=torch.tensor([4.0, random.uniform(0.5, 4.0), 1.5]),
            frame_indices=frames,
            timestamps_ns=frames,
            world_from_box=poses,
            num_points=frames,
        )


def test_twins_among_many_tracks_are_found_without_asking_about_each_pair(scene, monkeypatch):
    scene.tracks = tuple(random_tracks(scene.tracks[0], 80))
    are_twins, asked = actors._are_twins, []
    pairs = list(combinations(scene.tracks, 2))
    twins = [f"{a.actor_id} = {b.actor_id}" for a, b in pairs if are_twins(a, b)]
    assert len(twins) > 10
    monkeypatch.setattr(actors, "_are_twins", lambda *pair: asked.append(pair) or are_twins(*pair))
    detail = check_duplicate_tracks(scene)[1]
    assert detail == f"{len(twins)} pairs stand in the same place: {', '.join(twins[:3])}"
    assert len(asked) < len(pairs) / 10


def test_damaged_content_is_found(small_scene, tmp_path):
    shutil.copytree(small_scene.path, tmp_path / "scene")
    file = tmp_path / "scene/scene.zarr/point_intensity/c/0"
    content = bytearray(file.read_bytes())
    content[len(content) // 2] ^= 1
    file.write_bytes(content)
    assert verdicts(DrivingScene.open(tmp_path / "scene"))["stored content"] == "fail"


def test_single_frame_has_no_motion_to_check(sound_pandaset, tmp_path):
    found = verdicts(ingested(sound_pandaset, tmp_path, frames=slice(1, 2)))
    assert (found["ego poses"], found["sweeps agree"]) == ("warn", "warn")


@pytest.mark.parametrize("camera", ["front_camera", "back_camera"])
def test_overlay_draws_over_the_recorded_image(small_scene, camera):
    image = draw_overlay(small_scene, small_scene.view(1, camera))
    recorded = small_scene.read_image(small_scene.view(1, camera))
    changed = (image != recorded).any(dim=-1)
    assert image.shape == recorded.shape
    assert 0.01 < changed.float().mean() < 0.9
    assert not changed[:12].any()  # nothing is up in the sky


def test_overlay_draws_moving_boxes_green_where_the_car_is(small_scene):
    view = small_scene.view(1, "front_camera")
    image = draw_overlay(small_scene, small_scene.view(1, "front_camera")).float()
    greenness = image[..., 1] - image[..., [0, 2]].mean(dim=-1)
    track = next(track for track in small_scene.tracks if track.is_moving)
    pixels_uv, _ = view.camera.project(track.pose_at(view.timestamp_ns)[None, :3, 3])
    column, row = pixels_uv[0].round().int().tolist()
    around = greenness[row - 5 : row + 6, column - 6 : column + 7]
    assert around.max() > 80
    assert torch.isfinite(greenness).all()
