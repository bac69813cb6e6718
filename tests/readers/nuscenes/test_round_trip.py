"""A scene written as nuScenes and read back is the same scene."""

import torch
from scene_differences import scene_differences

from lidarpainter_models.checks.doctor import check_scene


def test_scene_comes_back_as_it_was(street, read_street):
    assert len(read_street.frame_indices) == 7
    assert len(read_street.views) == 7 * 6
    found = scene_differences(street, read_street)
    # points are float32, three times
    found.require_rounding(metres=1e-6, point_m=5e-5, degrees=1e-5)


def test_boxes_have_the_times_at_which_they_were_seen(street, read_street):
    tracks = {track.actor_id: track for track in read_street.tracks}
    for track in street.tracks:
        apart_ns = (tracks[track.actor_id].timestamps_ns - track.timestamps_ns).abs()
        assert apart_ns.max() < 20_000  # 0.2 mm at 10 m/s


def test_doctor_accepts_the_scene(read_street):
    assert [check for check in check_scene(read_street) if check.verdict != "ok"] == []


def test_rings_and_intensities_are_kept(street, read_street):
    true_points, points = street.read_points(3), read_street.read_points(3)
    assert torch.equal(points.ring, true_points.ring)
    assert torch.equal(points.intensity, (255 * true_points.intensity).round())


def test_firings_that_met_nothing_are_no_points(street, read_street):
    assert read_street.read_points(0).num_points == street.read_points(0).num_points


def test_moving_is_what_travels(street, read_street):
    for track in read_street.tracks:
        path_m = track.world_from_box[:, :3, 3] - track.world_from_box[0, :3, 3]
        assert track.is_moving == bool(path_m.norm(dim=1).max() >= 1.0)
    assert 3 <= sum(track.is_moving for track in read_street.tracks) < len(street.tracks) / 2
