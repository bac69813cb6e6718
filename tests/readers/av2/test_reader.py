"""A scene written as Argoverse 2 and read back is the same scene."""

import numpy as np
import pytest
import torch
from av2_log import HALF_TURN_NS, LOG, write_av2_log
from scene_differences import scene_differences
from written_logs import WrittenLog

from lidarpainter_models.checks.doctor import check_scene
from lidarpainter_models.geometry.transforms import (
    rigid_from_rotation,
    rotation_from_vector,
    transform_points,
)
from lidarpainter_models.readers import list_sequences
from lidarpainter_models.readers.av2.sweeps import LASERS, Av2Sweep, is_upper_first

UPSIDE_DOWN = rigid_from_rotation(
    rotation_from_vector(torch.tensor([np.pi, 0.1, 0.0], dtype=torch.float64)),
    torch.tensor([1.355, 0.0, 1.565], dtype=torch.float64),
)


def test_scene_comes_back_as_it_was(street, read_street):
    assert len(read_street.frame_indices) == 3
    found = scene_differences(street, read_street)
    found.require_rounding(metres=1e-6, point_m=5e-5, degrees=1e-5)


def test_doctor_accepts_the_scene(read_street):
    assert [check for check in check_scene(read_street) if check.verdict != "ok"] == []


def test_each_point_keeps_its_laser_its_intensity_and_its_time(street, read_street):
    true_sweep = street.read_sweep(street.sweeps_of(0)[0])
    upper, lower = (read_street.read_sweep(sweep) for sweep in read_street.sweeps_of(0))
    assert sorted(read_street.lidar_names) == ["down_lidar", "up_lidar"]
    rings = torch.cat([upper.ring, lower.ring + LASERS])
    is_first = true_sweep.ring < LASERS
    order = torch.cat([is_first.nonzero()[:, 0], (~is_first).nonzero()[:, 0]])
    assert torch.equal(rings, true_sweep.ring[order])
    intensity = torch.cat([upper.intensity, lower.intensity])
    assert torch.equal(intensity, true_sweep.intensity[order].round())
    middles_ns = [sweep.timestamp_ns for sweep in read_street.sweeps_of(0)]
    true_ns = street.sweeps_of(0)[0].timestamp_ns + true_sweep.time_offset_ns[order].long()
    times_ns = torch.cat([upper.time_offset_ns, lower.time_offset_ns]).long() + middles_ns[0]
    assert middles_ns[0] == middles_ns[1]
    assert torch.equal(times_ns, true_ns)


def test_boxes_have_the_times_at_which_the_lidar_saw_them(read_street):
    for track in read_street.tracks:
        if int(track.num_points.min()) < 20:
            continue
        for row, frame in enumerate(track.frame_indices.tolist()):
            sweep = read_street.sweeps_of(frame)[0]
            assert abs(int(track.timestamps_ns[row]) - sweep.timestamp_ns) <= HALF_TURN_NS
    assert sum(track.is_moving for track in read_street.tracks) > 0


def test_of_two_images_a_turn_the_one_in_its_middle_is_taken(street, read_street):
    assert [view.timestamp_ns for view in read_street.views] == [
        view.timestamp_ns for view in street.views
    ]


def test_city_names_the_frame_of_all_its_logs(read_street):
    assert read_street.manifest["global_frame"] == "av2-PIT"


def test_logs_of_splits_are_found_and_one_in_two_splits_is_refused(street, tmp_path):
    write_av2_log(street, tmp_path / "val", "log-1")
    assert list_sequences("av2", tmp_path) == ("log-1",)
    assert list_sequences("av2", tmp_path / "val") == ("log-1",)
    WrittenLog("av2", tmp_path, "log-1").read(tmp_path / "store", frames=slice(0, 1))
    (tmp_path / "train").mkdir()
    (tmp_path / "val/log-1").rename(tmp_path / "train/log-1")
    write_av2_log(street, tmp_path / "val", "log-1")
    with pytest.raises(ValueError, match="log-1 lies in several splits"):
        WrittenLog("av2", tmp_path, "log-1").ingest(tmp_path / "other")


def test_log_without_annotations_has_no_actors(log, tmp_path):
    (log.root / LOG / "annotations.feather").unlink()
    assert log.read(tmp_path / "store").tracks == ()


def test_coordinates_of_half_precision_are_read_as_they_are(street, tmp_path):
    write_av2_log(street, tmp_path / "log", coordinate=np.float16)
    scene = WrittenLog("av2", tmp_path / "log", LOG).read(tmp_path / "store", frames=slice(0, 1))
    found = scene_differences(street, scene, frames=[(0, 0)])
    assert 0.001 < found.point_m < 0.1  # 64 to 128 m away they are 6 cm apart


@pytest.mark.parametrize("is_upper", [True, False])
def test_points_tell_which_lidar_lasers_are_of(is_upper):
    """Each half keeps the elevations of its lasers in one LiDAR's frame alone."""
    rng = np.random.default_rng(0)
    upright = torch.eye(4, dtype=torch.float64)
    laser = rng.integers(0, 2 * LASERS, 4000)
    azimuth_rad, range_m = rng.uniform(-np.pi, np.pi, 4000), rng.uniform(3, 60, 4000)
    elevation_rad = np.radians(laser % LASERS - 16.0)
    xyz_m = range_m[:, None] * np.stack(
        [
            np.cos(elevation_rad) * np.cos(azimuth_rad),
            np.cos(elevation_rad) * np.sin(azimuth_rad),
            np.sin(elevation_rad),
        ],
        axis=1,
    )
    hangs = (laser < LASERS) != is_upper
    moved = transform_points(UPSIDE_DOWN, torch.from_numpy(xyz_m[hangs]))
    xyz_m[hangs] = moved.numpy()
    sweep = Av2Sweep("sweep", xyz_m, np.zeros(4000), laser, np.zeros(4000, np.int64))
    assert is_upper_first(sweep, {"up_lidar": upright, "down_lidar": UPSIDE_DOWN}) == is_upper
