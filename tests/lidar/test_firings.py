"""Sweeps of a street are brought back into the form in which its sensor fired them."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from tiny_street import tiny_street

from lidarpainter_models.errors import SceneError
from lidarpainter_models.geometry.transforms import rotation_from_vector
from lidarpainter_models.lidar.firings import mounted_lidar, recorded_rays
from lidarpainter_models.scenes.driving_scene import DrivingScene
from lidarpainter_models.synthetic import SyntheticStreet, write_street
from lidarpainter_models.synthetic.lidar_sensor import beam_inclinations_rad

LEAN_RAD = 0.016
CONFIG = tiny_street(seed=11, num_frames=3)
LIDAR = CONFIG.lidar


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return DrivingScene.open(write_street(CONFIG, tmp_path_factory.mktemp("store")))


@pytest.fixture(scope="module")
def lidar(scene):
    return mounted_lidar(scene, LIDAR.name)


def test_beams_and_steps_are_those_of_the_street(lidar):
    known = np.degrees(beam_inclinations_rad(LIDAR.beams))
    # of the bound of 0.05; ranges are noisy along the ray only
    assert np.abs(np.array(lidar.sensor.elevation_deg) - known).max() < 0.01
    assert lidar.sensor.steps == LIDAR.columns
    assert not lidar.sensor.turns_left


def test_every_ray_of_a_sweep_is_there_once(scene, lidar):
    sweep = scene.sweeps[1]
    rays = recorded_rays(scene, sweep, lidar)
    assert int(rays.is_returned.sum()) == sweep.num_points
    assert abs(len(rays) - LIDAR.beams * LIDAR.columns) < 0.01 * len(rays)
    points_m = rays.origin_m + rays.range_m[:, None] * rays.direction
    measured_m = scene.read_sweep(sweep).xyz_m.double()
    assert torch.allclose(points_m[rays.is_returned], measured_m, atol=1e-4)


def test_rays_that_nothing_sent_back_are_where_the_street_lost_them(scene, lidar):
    truth = SyntheticStreet(CONFIG).sweep(1)
    rays = recorded_rays(scene, scene.sweeps[1], lidar)
    lost = torch.bincount(rays.beam[~rays.is_returned], minlength=LIDAR.beams)
    back = torch.bincount(truth.points.ring.long(), minlength=LIDAR.beams)
    hidden = back < 20  # a beam that nothing sent back tells nothing
    expected = torch.where(hidden, 0, LIDAR.columns - back)
    # two points of a beam in one step, where noise has moved one
    assert bool(((lost - expected).abs() <= 4).all())


def test_a_lean_that_the_log_keeps_to_itself_is_found(scene):
    leant = rotation_from_vector(torch.tensor([LEAN_RAD, -0.5 * LEAN_RAD, 0.0]).double())
    hidden = torch.eye(4, dtype=torch.float64)
    hidden[:3, :3] = leant
    told = replace_poses(scene, hidden)
    without_rings = mounted_lidar(told, LIDAR.name)
    up = without_rings.lidar_from_sensor[:3, 2]
    assert torch.allclose(up, leant.mT[:, 2], atol=np.radians(0.05))


def test_a_place_that_the_log_has_wrong_is_found(scene):
    aside_m = torch.tensor([0.01, 0.0, -0.02]).double()
    hidden = torch.eye(4, dtype=torch.float64)
    hidden[:3, 3] = aside_m
    found = mounted_lidar(replace_poses(scene, hidden), LIDAR.name)
    # a street has no beam that meets things so near that a millimetre is told
    assert torch.allclose(found.lidar_from_sensor[:3, 3], -aside_m, atol=0.006)


def replace_poses(scene, lidar_from_lidar):
    """The scene, with LiDAR poses that lean against the true ones."""
    told = object.__new__(DrivingScene)
    told.__dict__ = dict(scene.__dict__)
    told.sweeps = tuple(
        replace(sweep, world_from_lidar=sweep.world_from_lidar @ lidar_from_lidar)
        for sweep in scene.sweeps
    )
    return told


def test_a_sweep_can_be_fired_again_from_where_it_was(scene, lidar):
    sweep = scene.sweeps[1]
    rays = lidar.rays(sweep.timestamp_ns)
    assert len(rays) == lidar.sensor.num_beams * lidar.sensor.steps
    middle = (rays.time_ns - sweep.timestamp_ns).abs() < 1_000_000
    where = sweep.world_from_lidar[:3, 3]
    assert torch.allclose(rays.origin_m[middle], where.expand(int(middle.sum()), 3), atol=0.05)
    assert torch.allclose(rays.direction.norm(dim=1), torch.ones(len(rays)).double())


def test_a_lidar_that_is_not_there_is_refused(scene):
    with pytest.raises(SceneError, match="no LiDAR 'roof', it has main_pandar64"):
        mounted_lidar(scene, "roof")
