"""Vehicles of a map made whole, against a shape that is known."""

from dataclasses import replace

import pytest
import torch
from gaussian_world import map_points

from lidarpainter_models.geometry.transforms import transform_points
from lidarpainter_models.lidar.lidar_map import NO_FRAME, LidarMap, MapPoints
from lidarpainter_models.lidar.vehicle_shapes import fitted_shape
from lidarpainter_models.lidar.whole_vehicles import LEAST_COLOURED, with_whole_vehicles
from lidarpainter_models.scenes.tracks import ActorTrack

SIZE_M = torch.tensor([4.7, 1.98, 1.45])
RED = torch.tensor([0.6, 0.1, 0.1])
AT = torch.eye(4, dtype=torch.float64)
AT[:3, 3] = torch.tensor([20.0, 5.0, float(SIZE_M[2]) / 2])
PLACES, NORMALS = fitted_shape(torch.zeros(0, 3), torch.zeros(0), SIZE_M).surface(0.05)
LEFT = (NORMALS[:, 1] > 0.3) | (NORMALS[:, 2] > 0.7)
RIGHT = (NORMALS[:, 1] < -0.35) & (NORMALS[:, 2] > -0.4) & (PLACES[:, 2] > -0.6)


def track(*, is_moving, category="car"):
    return ActorTrack(
        actor_id="one",
        category=category,
        is_moving=is_moving,
        size_m=SIZE_M,
        frame_indices=torch.arange(2),
        timestamps_ns=torch.tensor([0, 100_000_000]),
        world_from_box=AT.repeat(2, 1, 1),
        num_points=torch.tensor([500, 500]),
    )


def seen_left():
    """The left side and the roof in red; of the rear half the colour is not known."""
    points = map_points(PLACES[LEFT], RED.expand(int(LEFT.sum()), 3))
    is_bare = points.xyz_m[:, 0] < -1.5
    rgb_u8 = points.rgb_u8.clone()
    rgb_u8[is_bare] = 0
    return replace(points, rgb_u8=rgb_u8, has_colour=~is_bare)


def road():
    """Ground about the car, none of it the car's."""
    flat = torch.cartesian_prod(torch.arange(14.0, 26, 0.25), torch.arange(1.0, 9, 0.25))
    xyz_m = torch.cat([flat, torch.zeros(len(flat), 1)], dim=1)
    return map_points(xyz_m, torch.full_like(xyz_m, 0.4))


def test_a_moving_car_gets_its_other_side_and_a_parked_one_the_same():
    moving = with_whole_vehicles(
        LidarMap(street=road(), actors={"one": seen_left()}), [track(is_moving=True)]
    )
    parked = with_whole_vehicles(
        LidarMap(street=MapPoints.concatenate([road(), seen_left().moved(AT)]), actors={}),
        [track(is_moving=False)],
    )
    assert len(moving.street) == len(road())
    own = moving.actors["one"]
    new = own.keep(own.frame_index == NO_FRAME)
    right = PLACES[RIGHT]
    distance_m = torch.cdist(right, new.xyz_m).amin(1)
    assert float((distance_m < 0.12).float().mean()) > 0.9
    assert bool((new.xyz_m.abs() < 1.05 * SIZE_M / 2).all())
    assert float((new.rgb_u8.float() / 255 - RED).abs().mean()) < 0.2
    beside = parked.street.keep(parked.street.frame_index == NO_FRAME)
    assert len(beside) == pytest.approx(len(new), rel=0.25)
    there = transform_points(AT.float(), new.xyz_m)
    assert float(torch.cdist(there, beside.xyz_m).amin(1).median()) < 0.05


def test_what_was_measured_stays_as_it_was():
    before = LidarMap(street=road(), actors={"one": seen_left()})
    after = with_whole_vehicles(before, [track(is_moving=True)])
    own = after.measured().actors["one"]
    for name, column in seen_left().to_arrays().items():
        assert torch.equal(own.to_arrays()[name], column), name


def test_where_no_image_saw_a_measured_side_its_colour_is_guessed():
    before = LidarMap(street=road(), actors={"one": seen_left()})
    after = with_whole_vehicles(before, [track(is_moving=True)]).actors["one"]
    new = after.keep(after.frame_index == NO_FRAME)
    rear_left = (new.xyz_m[:, 0] < -1.8) & (new.xyz_m[:, 1] > 0.6)
    assert int(rear_left.sum()) > 20
    assert bool(new.has_colour.all())


def test_nothing_is_guessed_under_a_parked_car():
    street = MapPoints.concatenate([road(), seen_left().moved(AT)])
    after = with_whole_vehicles(LidarMap(street=street, actors={}), [track(is_moving=False)])
    new = after.street.keep(after.street.frame_index == NO_FRAME)
    assert float(new.xyz_m[:, 2].min()) > 0.04


@pytest.mark.parametrize("case", ["pedestrian", "few", "colourless"])
def test_who_is_too_little_known_stays_as_he_was(case):
    points = seen_left()
    if case == "few":
        points = points.keep(slice(0, LEAST_COLOURED - 1))
    if case == "colourless":
        points = replace(points, has_colour=torch.zeros_like(points.has_colour))
    before = LidarMap(street=road(), actors={"one": points})
    category = "pedestrian" if case == "pedestrian" else "car"
    after = with_whole_vehicles(before, [track(is_moving=True, category=category)])
    assert torch.equal(after.actors["one"].xyz_m, points.xyz_m)
    assert torch.equal(after.actors["one"].has_colour, points.has_colour)
