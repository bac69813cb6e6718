"""Sensors are found from their sweeps to a twentieth of a degree of what is known of them."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from waymo_real import RealFrame

from lidarpainter_models.lidar.firings import fired_rays
from lidarpainter_models.lidar.sensor_estimates import SeenPoints, beam_elevations, sensor_seat
from lidarpainter_models.lidar.sensors import PRESETS, LidarSensor
from lidarpainter_models.readers.waymo.calibration import TOP

MOST_DEG = 0.05


def seen_points(points_m, ring):
    count = len(points_m)
    return SeenPoints(
        points_m=points_m,
        time_ns=np.zeros(count, np.int64),
        ring=ring.astype(np.int64),
        intensity=np.zeros(count),
        is_first=np.ones(count, bool),
    )


def seated(seen):
    """The points as a sensor sees them whose seat is found from them."""
    seat = sensor_seat([seen.points_m])
    return replace(seen, points_m=(seen.points_m - seat[:3, 3]) @ seat[:3, :3])


@pytest.mark.parametrize("knows_rings", [True, False])
def test_a_recorded_hdl_32e_has_the_beams_of_its_sheet(shared_folder, knows_rings):
    (file,) = (shared_folder / "data/nuscenes_keyframe").glob("*.pcd.bin")
    firings = np.fromfile(file, "<f4").reshape(-1, 32, 5).astype(float)
    met = np.linalg.norm(firings[..., :3], axis=2) > 2
    nowhere = np.abs(firings[..., 0]) < 0.01  # what met nothing is stored where the sensor was
    columns = np.nonzero(~met & nowhere)[0]
    for axis in range(3):  # the car drives and heaves while the sensor turns
        way_m = np.polyfit(columns, firings[~met & nowhere][:, axis], 2)
        firings[..., axis] -= np.polyval(way_m, np.arange(len(firings)))[:, None]
    ring = firings[met][:, 4] if knows_rings else np.full(met.sum(), -1)
    found, are_apart = beam_elevations([seated(seen_points(firings[met][:, :3], ring))])
    assert are_apart
    assert np.abs(np.sort(found)[::-1] - PRESETS["hdl-32e"].elevation_deg).max() < MOST_DEG


def test_beams_of_waymos_table_are_found_in_a_sweep_that_is_made_with_it(shared_folder):
    frame = shared_folder / "data/waymo_frame/pvps_data_one_frame.tfrecord"
    beams_deg = np.degrees(RealFrame.read(frame).segment.lidars[TOP].beams_rad)
    sensor = LidarSensor(name="top", elevation_deg=tuple(map(float, beams_deg)), steps=2650)
    points_m = street_met(fired(sensor), np.random.default_rng(0))
    found, are_apart = beam_elevations([seated(seen_points(points_m, np.full(len(points_m), -1)))])
    assert are_apart
    assert len(found) == 64
    assert np.abs(np.sort(found) - np.sort(beams_deg)).max() < MOST_DEG


def fired(sensor):
    poses = torch.eye(4).double().expand(sensor.steps, 4, 4)
    return fired_rays(sensor, poses, torch.zeros(sensor.steps).long()).direction.numpy()


def street_met(directions, random):
    """A road 2.1 m below and walls 12 m beside and 60 m ahead and behind, 2 cm of noise."""
    limits = np.array([60.0, 12.0, 2.1])
    away_m = np.min(limits / np.maximum(np.abs(directions), 1e-9), axis=1)
    away_m += 0.02 * random.standard_normal(len(away_m))
    return directions * away_m[:, None]
