from dataclasses import replace

import pytest
import torch
from gaussian_world import bare_points
from toy_street import CAR_SIZE_M, CAR_X_M, WALL_X_M, ToyStreet

from lidarpainter_models.errors import SceneError
from lidarpainter_models.lidar import map_building
from lidarpainter_models.lidar.actor_separation import CLEARANCE_M, ROAD_HEIGHT_M, poses_at
from lidarpainter_models.lidar.ground_heights import GroundHeights
from lidarpainter_models.lidar.lidar_map import LidarMap
from lidarpainter_models.lidar.map_building import build_lidar_map, gather_points
from lidarpainter_models.scenes.records import SweepPoints


@pytest.fixture(scope="module")
def street():
    return ToyStreet()


@pytest.fixture(scope="module")
def lidar_map(street):
    return build_lidar_map(street, split_frames=(0, 2, 3), colour_views=())


def test_a_passing_car_leaves_nothing_in_the_street(lidar_map):
    xyz_m = lidar_map.street.xyz_m
    is_ground = xyz_m[:, 2].abs() < ROAD_HEIGHT_M
    is_wall = (xyz_m[:, 0] - WALL_X_M).abs() < 0.01
    assert bool((is_ground | is_wall).all())
    assert int(is_wall.sum()) > 1000


def test_points_of_a_moving_car_fall_onto_its_box(lidar_map):
    # the car moves a metre during each sweep
    points = lidar_map.actors["car"]
    assert len(points) > 300
    half_m = CAR_SIZE_M / 2
    assert bool((points.xyz_m.abs() <= half_m + 0.03).all())
    outside_m = (points.xyz_m.abs() - half_m).amax(dim=-1)
    assert float(outside_m.abs().max()) < 0.03
    assert sorted(points.frame_index.unique().tolist()) == [0, 2, 3]


def test_the_road_beside_a_car_stays_street_and_is_no_part_of_it(lidar_map):
    lowest_m = lidar_map.actors["car"].xyz_m[:, 2].min() + CAR_SIZE_M[2] / 2
    assert float(lowest_m) >= CLEARANCE_M - 1e-3
    street = lidar_map.street
    near_car = (street.xyz_m[:, 0] - (CAR_X_M - 1.0)).abs() < 0.1
    assert int((near_car & (street.xyz_m[:, 1].abs() < 2)).sum()) > 10


def test_a_point_remembers_when_and_from_how_far_it_was_measured(street, monkeypatch):
    monkeypatch.setattr(map_building, "LEAST_WAY_M", 0.0)  # the street stands
    street = build_lidar_map(street, split_frames=(0, 2, 3), colour_views=()).street
    assert sorted(street.frame_index.unique().tolist()) == [0, 2, 3]
    away_s = (street.timestamp_ns - street.frame_index * 100_000_000).abs() * 1e-9
    assert float(away_s.max()) <= 0.0501
    eye = torch.tensor([0.0, 0.0, 1.7])
    torch.testing.assert_close(street.range_m, (street.xyz_m - eye).norm(dim=-1))


def test_of_a_lidar_that_stands_few_sweeps_show_the_street_and_all_who_moves():
    standing = build_lidar_map(ToyStreet(num_frames=8), split_frames=range(8), colour_views=())
    assert sorted(standing.street.frame_index.unique().tolist()) == [0, 5]
    (car,) = standing.actors.values()
    assert len(car.frame_index.unique()) > 5


def test_ranges_out_of_bounds_are_left_out(street, monkeypatch):
    monkeypatch.setattr(map_building, "MAX_RANGE_M", 15.0)
    lidar_map = build_lidar_map(street, split_frames=(0,), colour_views=())
    assert float(lidar_map.street.range_m.max()) <= 15


def test_the_ego_vehicle_itself_leaves_no_points():
    street = ToyStreet(num_frames=1)
    bonnet, beside = [1.8, 0.3, 1.0], [0.2, 1.9, 1.0]
    read = street.read_sweep(street.sweeps[0])
    twice = torch.tensor([bonnet, bonnet, beside, beside])  # what returns alone is a drop
    added = torch.cat([twice, read.xyz_m[4:]])
    street.read_sweep = lambda _: replace(read, xyz_m=added)
    xyz_m = build_lidar_map(street, split_frames=(0,), colour_views=()).street.xyz_m
    assert not (xyz_m == torch.tensor(bonnet)).all(-1).any()
    assert (xyz_m == torch.tensor(beside)).all(-1).any()


def drops_of(share, count):
    """Points in the air around the toy street's LiDAR, no two in one direction and range."""
    number = round(share * count)
    turn, range_m = torch.linspace(-3, 3, number), torch.linspace(4, 9, 7).repeat(number)[:number]
    return torch.stack([range_m * turn.cos(), range_m * turn.sin(), 2.5 + 0 * turn], dim=1)


@pytest.mark.parametrize(("share", "is_left_out"), [(0.03, True), (0.004, False)])
def test_drops_in_the_air_leave_no_point_where_they_are_many(share, is_left_out):
    street = ToyStreet(num_frames=1)
    read = street.read_sweep(street.sweeps[0])
    drops = drops_of(share, len(read.xyz_m))
    mixed = torch.cat([drops, read.xyz_m[len(drops) :]])
    street.read_sweep = lambda _: replace(read, xyz_m=mixed)
    found = build_lidar_map(street, split_frames=(0,), colour_views=()).street.xyz_m
    left = (found[:, None] == drops).all(-1).any(0).float().mean()
    assert (left < 0.1) if is_left_out else (left > 0.9)


def test_no_points_is_an_error(street):
    with pytest.raises(SceneError, match="no LiDAR point"):
        build_lidar_map(street, split_frames=(), colour_views=())


@pytest.mark.parametrize("frames", [(), (0,)])
def test_sweeps_that_met_nothing_give_no_points(frames):
    street = ToyStreet()
    street.read_sweep = lambda _: SweepPoints.of(torch.zeros(0, 3))
    nothing = gather_points(street, frames)
    assert (len(nothing.street), nothing.actors) == (0, {})


def test_motion_goes_on_for_a_sweep_beyond_the_last_box(street):
    track = street.tracks[0]
    end_ns = int(track.timestamps_ns[-1])
    y_m = poses_at(track, torch.tensor([end_ns - 50_000_000, end_ns + 50_000_000]))[:, 1, 3]
    assert float(y_m[1] - y_m[0]) == pytest.approx(1.0, abs=1e-6)


def test_ground_is_a_low_quantile_and_unknown_where_nothing_fell():
    generator = torch.Generator().manual_seed(0)
    xyz_m = torch.rand(5000, 3, generator=generator) * torch.tensor([4.0, 4.0, 0.02])
    xyz_m[::5, 2] += 2.0  # things on the ground
    xyz_m[0, 2] = -3.0  # a reflection
    ground = GroundHeights(xyz_m)
    heights_m = ground.at(torch.tensor([[0.5, 0.5], [3.5, 1.5], [9.0, 9.0]]))
    assert float(heights_m[:2].abs().max()) < 0.02
    assert bool(heights_m[2].isnan())
    assert bool(GroundHeights(torch.zeros(0, 3)).at(torch.zeros(1, 2)).isnan())


def test_points_near_a_place_are_those_nearer_than_the_radius():
    xyz_m = 4 * torch.rand(3_000, 3, generator=torch.Generator().manual_seed(0)) - 2
    street = bare_points(xyz_m)
    lidar_map = LidarMap(street=street, actors={})
    for place_m in (*xyz_m[:5], torch.tensor([9.0, 0.0, 0.0])):
        expected = int(((xyz_m - place_m).norm(dim=1) < 0.6).sum())
        assert lidar_map.num_street_points_near(place_m.double(), 0.6) == expected
    nothing = LidarMap(street=street.keep(slice(0, 0)), actors={})
    assert nothing.num_street_points_near(xyz_m[0], 0.6) == 0
