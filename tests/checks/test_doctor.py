"""Each way to get a scene wrong is found by the check that looks for it."""

import shutil
from dataclasses import replace
from itertools import combinations

import cv2
import numpy as np
import pytest
import torch

from lidarpainter_models.checks import actors, traffic
from lidarpainter_models.checks.actors import (
    check_box_axes,
    check_box_points,
    check_duplicate_tracks,
    check_lasting_ids,
)
from lidarpainter_models.checks.doctor import (
    check_camera_rig,
    check_camera_sync,
    check_ego_poses,
    check_scene,
    check_timestamps,
)
from lidarpainter_models.checks.overlay import draw_overlay
from lidarpainter_models.checks.pictures import check_pictures
from lidarpainter_models.checks.sweeps import (
    check_clear_air,
    check_coverage,
    check_ground,
    check_origins,
    check_sweeps_agree,
)
from lidarpainter_models.scenes.driving_scene import DrivingScene


def ingested(log, tmp_path, **options):
    return DrivingScene.open(log.ingest(tmp_path / "store", **options))


def finding(scene, name):
    return next(check for check in check_scene(scene) if check.name == name)


def test_sound_scene_passes_every_check(small_scene):
    checks = check_scene(small_scene)
    assert [check for check in checks if check.verdict != "ok"] == []
    assert len({check.name for check in checks}) == 21


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
    verdict, detail = check_ego_poses(scene)
    assert verdict == "fail"
    assert "a jump at frame 2" in detail


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
    verdict, detail = check_ego_poses(scene)
    assert verdict == "fail"
    assert "drives across its x axis: is ego x forward, y left?" in detail
    scene.world_from_ego = scene.world_from_ego @ across  # backwards is a way to drive
    assert check_ego_poses(scene)[0] == "ok"


def test_times_in_another_unit_are_said_in_one_line(scene):
    scene.frame_timestamps_ns = scene.frame_timestamps_ns // 1000
    verdict, detail = check_ego_poses(scene)
    assert verdict == "fail"
    assert "m/s throughout, no car does: times must be in nanoseconds" in detail


@pytest.mark.parametrize("level", [0, 200])
def test_camera_whose_images_show_nothing_is_found(scene, monkeypatch, level):
    read, random = scene.read_image, np.random.default_rng(0)

    def blank(view):
        image = read(view)
        if view.camera_name != "left_camera":
            return image
        return torch.from_numpy(random.integers(level, level + 2, image.shape).astype(np.uint8))

    monkeypatch.setattr(scene, "read_image", blank)
    look = "black" if level == 0 else "of one even brightness"
    verdict, detail = check_pictures(scene)
    assert verdict == ("fail" if level == 0 else "warn")
    assert detail.startswith(f"left_camera is {look} in all 3 images")


def test_one_black_image_among_others_is_found(scene, monkeypatch):
    read, black = scene.read_image, scene.views[0]
    monkeypatch.setattr(scene, "read_image", lambda view: read(view) * (0 if view == black else 1))
    verdict, said = check_pictures(scene)
    assert verdict == "warn"
    assert said.startswith(f"1 of {black.camera_name}'s images show nothing")


def test_actor_that_drives_though_it_is_said_to_stand_is_found(scene):
    moved = next(track for track in scene.tracks if track.is_moving)
    place = moved.world_from_box.clone()
    place[-1, 0, 3] += 20
    scene.tracks = (replace(moved, is_moving=False, world_from_box=place),)
    verdict, said = traffic.check_traffic(scene)
    assert verdict == "warn"
    assert f"1 actors said to stand go farther than 3 m ({moved.actor_id}" in said


def test_even_border_around_images_is_found(scene, monkeypatch):
    read, edged = scene.read_image, scene.camera_names[0]

    def with_border(view):
        image = read(view).clone()
        if view.camera_name == edged:
            image[:2], image[-2:], image[:, :2], image[:, -2:] = 0, 0, 0, 0
        return image

    monkeypatch.setattr(scene, "read_image", with_border)
    verdict, said = check_pictures(scene)
    assert verdict == "warn"
    assert said.startswith(f"an even border around the images of {edged} (")


def test_white_sky_over_a_level_horizon_is_no_border(scene, monkeypatch):
    read = scene.read_image

    def with_sky(view):
        image = read(view).clone()
        image[: len(image) // 3] = 255
        return image

    monkeypatch.setattr(scene, "read_image", with_sky)
    assert "border" not in check_pictures(scene)[1]


def test_camera_whose_images_have_no_colour_is_found(scene, monkeypatch):
    read, grey = scene.read_image, scene.camera_names[0]

    def without_colour(view):
        rgb_u8 = read(view)
        return rgb_u8[..., :1].expand_as(rgb_u8) if view.camera_name == grey else rgb_u8

    monkeypatch.setattr(scene, "read_image", without_colour)
    verdict, said = check_pictures(scene)
    assert verdict == "warn"
    assert f"no colour in the images of {grey}:" in said


def test_slow_traffic_without_any_box_is_said_not_to_be_checked(scene, monkeypatch):
    monkeypatch.setattr(traffic, "_triples", lambda _scene: [(None, None, None)])
    monkeypatch.setattr(traffic, "_num_moved", lambda *_sweeps: 0)
    assert "not checked" not in traffic.check_traffic(scene)[1]
    scene.tracks = ()
    assert "less than its own length in 0.4 s was not checked" in traffic.check_traffic(scene)[1]


def test_what_a_check_cannot_compute_ends_no_run(scene):
    scene.tracks = None
    check = finding(scene, "boxes point ahead")
    assert check.verdict == "warn"
    assert check.detail.startswith("not checked: it could not be computed (TypeError: ")


def test_origin_on_the_road_is_found_and_no_rain(scene):
    assert check_origins(scene)[0] == "ok"
    lowered = torch.tensor([0.0, 0.0, 1.8], dtype=torch.float64)
    scene.sweeps = tuple(
        replace(sweep, world_from_lidar=moved_down(sweep.world_from_lidar, lowered))
        for sweep in scene.sweeps
    )
    verdict, detail = check_origins(scene)
    assert verdict == "warn"
    assert "world_from_lidar must be where the LiDAR is" in detail
    assert "rain" not in check_clear_air(scene)[1]


def moved_down(pose, by_m):
    lower = pose.clone()
    lower[:3, 3] -= by_m
    return lower


def test_camera_clock_off_by_half_a_second_is_found(scene):
    change_views(
        scene,
        "left_camera",
        lambda view, _: replace(view, timestamp_ns=view.timestamp_ns + 500_000_000),
    )
    assert check_camera_sync(scene)[0] == "fail"


def test_camera_times_that_run_backwards_are_found(scene):
    times_ns = [view.timestamp_ns for view in scene.views_of("left_camera")][::-1]
    change_views(scene, "left_camera", lambda view, row: replace(view, timestamp_ns=times_ns[row]))
    first, second = scene.views_of("left_camera")[:2]
    verdict, told = check_timestamps(scene)
    assert verdict == "fail"
    assert (
        f"frame {second.frame_index} has an image 100 ms older than frame {first.frame_index}'s"
        in told
    )


def test_a_pause_of_the_recorder_is_told_with_its_place(scene):
    scene.frame_timestamps_ns[2:] += 2_000_000_000
    verdict, told = check_timestamps(scene)
    assert verdict == "warn"
    assert f"1 gaps, the longest of 2.1 s before frame {scene.frame_indices[2]}" in told


def test_camera_that_leaves_its_mount_is_found(pandaset, tmp_path):
    move = {"x": 103.0, "y": -47.0}
    pandaset.edit_json(
        "camera/back_camera/poses.json", lambda poses: poses[1]["position"].update(move)
    )
    assert check_camera_rig(ingested(pandaset, tmp_path))[0] == "warn"


def test_images_after_the_last_pose_of_the_car_say_nothing_of_the_mount(scene):
    last_ns = int(scene.frame_timestamps_ns[-1])

    def late(view, row):
        if row < len(scene.frame_indices) - 1:
            return view
        further = view.camera.world_from_camera.clone()
        further[0, 3] += 1.0
        return replace(view, timestamp_ns=last_ns + 100_000_000, camera=view.camera.at(further))

    change_views(scene, "right_camera", late)
    assert check_camera_rig(scene)[0] == "ok"


def test_camera_that_looks_into_the_sky_is_found(scene):
    def look_up(view, _row):
        pose = view.camera.world_from_camera.clone()
        pose[:3, :3] = torch.eye(3)
        return replace(view, camera=replace(view.camera, world_from_camera=pose))

    change_views(scene, "right_camera", look_up)
    verdict, detail = check_coverage(scene)
    assert verdict == "fail"
    assert "right_camera 0%" in detail


def test_sweep_that_lies_beside_the_others_is_found(pandaset, tmp_path):
    pandaset.edit_points(1, lambda xyz_m: xyz_m + np.array([0.4, 0.4, 0.3]))
    assert check_sweeps_agree(ingested(pandaset, tmp_path))[0] == "fail"


def test_ground_that_stands_on_edge_is_found(pandaset, tmp_path):
    for index in range(3):
        pandaset.edit_points(
            index, lambda xyz_m: xyz_m + 0.3 * (xyz_m[:, :1] - 100.0) * [[0, 0, 1]]
        )
    assert check_ground(ingested(pandaset, tmp_path))[0] == "fail"


def change_boxes(log, change):
    for index, time_s in enumerate(log.frame_times_s()):
        log.write_boxes(index, [change(box) for box in log.boxes_at(time_s)])


def test_boxes_beside_their_cars_are_found(pandaset, tmp_path):
    change_boxes(pandaset, lambda box: {**box, "centre": box["centre"] + [3.0, -3.0, 0.0]})
    assert check_box_points(ingested(pandaset, tmp_path))[0] == "fail"


def test_boxes_that_drive_sideways_are_found(pandaset, tmp_path):
    change_boxes(pandaset, lambda box: {**box, "yaw_deg": 45.0})
    assert check_box_axes(ingested(pandaset, tmp_path))[0] == "fail"


def test_some_turned_boxes_are_no_wrong_convention(pandaset, tmp_path):
    for index, time_s in enumerate(pandaset.frame_times_s()[1:], start=1):
        boxes = pandaset.boxes_at(time_s)
        pandaset.write_boxes(index, [{**box, "yaw_deg": 45.0} for box in boxes])
    assert check_box_axes(ingested(pandaset, tmp_path))[0] == "warn"


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


def with_path(scene, times_s, path_m, axes):
    """The scene with one moving actor that stands so and looks so at some times."""
    boxes = torch.eye(4, dtype=torch.float64).repeat(len(times_s), 1, 1)
    boxes[:, :2, 3] = torch.tensor(path_m, dtype=torch.float64)
    boxes[:, :2, 0] = torch.tensor(axes, dtype=torch.float64)
    boxes[:, :2, 1] = boxes[:, :2, 0] @ torch.tensor([[0.0, 1.0], [-1.0, 0.0]]).double()
    rows = torch.arange(len(times_s))
    scene.tracks = (
        replace(
            next(track for track in scene.tracks if track.is_moving),
            world_from_box=boxes,
            frame_indices=rows,
            timestamps_ns=torch.tensor([round(1e9 * time_s) for time_s in times_s]),
            num_points=rows,
        ),
    )
    return scene


def test_a_turn_and_a_gap_in_a_track_are_no_wrong_convention(scene):
    angles = np.linspace(0, np.pi, 12)
    turn_m = 6 * np.stack([np.sin(angles), 1 - np.cos(angles)], axis=1)
    looks = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    times_s = [0.2 * step for step in range(12)]
    assert check_box_axes(with_path(scene, times_s, turn_m, looks))[0] == "ok"
    there_m = [[2.0 * step, 0.0] for step in range(4)]
    back_m = [[6.0 - 2.0 * step, 30.0] for step in range(4)]  # away for 20 s, and elsewhere then
    times_s = [0.2 * step for step in range(4)] + [20 + 0.2 * step for step in range(4)]
    looks = [[1.0, 0.0]] * 4 + [[-1.0, 0.0]] * 4
    assert check_box_axes(with_path(scene, times_s, there_m + back_m, looks))[0] == "ok"


def test_points_on_the_faces_of_a_box_are_held(scene):
    moving = [track for track in scene.tracks if track.is_moving]
    scene.tracks = tuple(
        replace(track, num_points=torch.zeros_like(track.num_points)) for track in moving
    )
    corners = [
        (
            track.world_from_box[row]
            @ torch.tensor([*(track.size_m.double() / 2 * side), 1.0]).double()
        )[:3]
        for track in scene.tracks
        for row in range(len(track.frame_indices))
        for side in (torch.tensor([-1.0, 0.0, 0.0]),)
    ]
    on_faces = torch.stack(corners).float()
    read = scene.read_column
    scene.read_column = lambda sweep, name: (
        torch.cat([read(sweep, name), on_faces]) if name == "xyz_m" else read(sweep, name)
    )
    assert check_box_points(scene)[0] == "ok"


def test_ids_that_do_not_last_are_found(scene):
    assert check_lasting_ids(scene)[0] == "ok"
    scene.tracks = tuple(
        replace(
            track,
            actor_id=f"{track.actor_id}.{copy}.{row}",
            frame_indices=track.frame_indices[row : row + 1],
            timestamps_ns=track.timestamps_ns[row : row + 1],
            world_from_box=track.world_from_box[row : row + 1],
            num_points=track.num_points[row : row + 1],
        )
        for copy, track in enumerate([*scene.tracks] * 5)
        for row in range(len(track.frame_indices))
    )
    verdict, detail = check_lasting_ids(scene)
    assert verdict == "warn"
    assert "ids must last" in detail


def test_actor_with_two_tracks_is_found(pandaset, tmp_path):
    change_boxes(pandaset, lambda box: {**box, "sibling": "-"})
    scene = ingested(pandaset, tmp_path)
    verdict, detail = check_duplicate_tracks(scene)
    assert verdict == "warn"
    assert "moving-1 = moving-0" in detail


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


def test_twins_among_many_tracks_are_all_found(scene):
    scene.tracks = tuple(random_tracks(scene.tracks[0], 80))
    pairs = combinations(scene.tracks, 2)
    twins = [f"{a.actor_id} = {b.actor_id}" for a, b in pairs if actors._are_twins(a, b)]
    assert len(twins) > 10
    detail = check_duplicate_tracks(scene)[1]
    assert detail == f"{len(twins)} pairs stand in the same place: {', '.join(twins[:3])}"


def test_damaged_content_is_found(small_scene, tmp_path):
    shutil.copytree(small_scene.path, tmp_path / "scene")
    file = tmp_path / "scene/scene.zarr/point_intensity/c/0"
    content = bytearray(file.read_bytes())
    content[len(content) // 2] ^= 1
    file.write_bytes(content)
    damaged = DrivingScene.open(tmp_path / "scene")
    assert finding(damaged, "stored content").verdict == "fail"


def test_single_frame_has_no_motion_to_check(sound_pandaset, tmp_path):
    scene = ingested(sound_pandaset, tmp_path, frames=slice(1, 2))
    assert (check_ego_poses(scene)[0], check_sweeps_agree(scene)[0]) == ("warn", "warn")


@pytest.mark.parametrize("camera", ["front_camera", "back_camera"])
def test_overlay_draws_over_the_recorded_image(small_scene, camera):
    image = draw_overlay(small_scene, small_scene.view(1, camera))
    recorded = small_scene.read_image(small_scene.view(1, camera))
    times = image.shape[1] // recorded.shape[1]
    enlarged = torch.from_numpy(cv2.resize(recorded.numpy(), None, fx=times, fy=times))
    assert image.shape == enlarged.shape
    blocks = (image != enlarged).any(dim=-1).unflatten(1, (-1, times)).unflatten(0, (-1, times))
    changed = blocks.any(dim=3).any(dim=1)
    assert image.shape[1] >= 700  # a small image is not hidden by points
    assert 0.01 < changed.float().mean() < 0.9
    assert not changed[:12].any()  # nothing is up in the sky


def test_overlay_draws_moving_boxes_green_where_the_car_is(small_scene):
    view = small_scene.view(1, "front_camera")
    image = draw_overlay(small_scene, small_scene.view(1, "front_camera")).float()
    greenness = image[..., 1] - image[..., [0, 2]].mean(dim=-1)
    track = next(track for track in small_scene.tracks if track.is_moving)
    pixels_uv, _ = view.camera.project(track.pose_at(view.timestamp_ns)[None, :3, 3])
    times = image.shape[1] // view.camera.width_px
    column, row = (times * pixels_uv[0]).round().int().tolist()
    around = greenness[row - 5 : row + 6, column - 6 : column + 7]
    assert around.max() > 80
    assert torch.isfinite(greenness).all()
