"""Returns of a frame, moving actors where an image shows them."""

import torch
from toy_street import CAR_SIZE_M, WALL_X_M, ToyStreet, world_from_car

from lidarpainter_models.geometry.transforms import invert_rigid, transform_points
from lidarpainter_models.lidar.sparse_depth import FramePoints


def of_the_car(points_world):
    """Those that neither the ground nor the wall behind has."""
    return points_world[(points_world[:, 2] > 0.3) & (points_world[:, 0] < WALL_X_M - 1)]


def outside_m(points_world, time_s):
    """How far points lie outside the car as it stands at a time."""
    points = transform_points(invert_rigid(world_from_car(time_s)).float(), points_world)
    return (points.abs() - CAR_SIZE_M / 2).amax(dim=-1)


def test_points_of_a_moving_car_are_brought_from_their_own_time_to_the_image():
    street = ToyStreet()
    lidar = FramePoints(street)
    for view in street.views:
        time_s = view.timestamp_ns * 1e-9
        as_measured = of_the_car(lidar.measured(view.frame_index))
        assert float(outside_m(as_measured, time_s).max()) > 0.1
        placed = of_the_car(lidar.at_exposure(view))
        assert len(placed) == len(as_measured)
        assert float(outside_m(placed, time_s).max()) < 0.02


def test_what_stands_stays_where_it_was_measured():
    street = ToyStreet()
    lidar, view = FramePoints(street), street.views[2]
    is_wall = lidar.measured(2)[:, 0] > WALL_X_M - 1
    assert torch.equal(lidar.measured(2)[is_wall], lidar.at_exposure(view)[is_wall])


def test_a_frame_without_sweeps_has_no_points():
    assert FramePoints(ToyStreet()).measured(9).shape == (0, 3)
