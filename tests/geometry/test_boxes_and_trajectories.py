"""Boxes hold points; shifted paths stay beside the road."""

import math

import pytest
import torch

from lidarpainter_models.errors import ConfigError
from lidarpainter_models.geometry.boxes import box_corners, count_points_in_boxes, is_inside_box
from lidarpainter_models.geometry.shifts import Shift
from lidarpainter_models.geometry.trajectories import road_directions, shift_pose
from lidarpainter_models.geometry.transforms import rigid_from_tangent, transform_points


def path(xs: list[float], yaw_rad: float = 0.0) -> torch.Tensor:
    tangents = torch.zeros(len(xs), 6, dtype=torch.float64)
    tangents[:, 2] = yaw_rad
    poses = rigid_from_tangent(tangents)
    poses[:, 0, 3] = torch.tensor(xs, dtype=torch.float64) * math.cos(yaw_rad)
    poses[:, 1, 3] = torch.tensor(xs, dtype=torch.float64) * math.sin(yaw_rad)
    return poses


def test_box_holds_its_shrunken_corners_and_not_its_grown_ones():
    world_from_box = rigid_from_tangent(torch.tensor([0.1, -0.2, 0.7, 3, 4, 5]).double())
    size_m = torch.tensor([4.0, 2.0, 1.5], dtype=torch.float64)
    corners = box_corners(size_m)
    inner = transform_points(world_from_box, corners * 0.99)
    outer = transform_points(world_from_box, corners * 1.01)
    assert is_inside_box(inner, world_from_box, size_m).all()
    assert not is_inside_box(outer, world_from_box, size_m).any()
    assert is_inside_box(outer, world_from_box, size_m, margin_m=0.1).all()


def test_points_are_counted_in_every_box_as_one_by_one():
    generator = torch.Generator().manual_seed(0)
    points = 10 * torch.randn(2000, 3, generator=generator)
    poses = rigid_from_tangent(torch.randn(7, 6, generator=generator, dtype=torch.float64) * 2)
    sizes_m = 1 + 6 * torch.rand(7, 3, generator=generator)
    counts = count_points_in_boxes(points, poses, sizes_m)
    expected = [
        int(is_inside_box(points, pose, size_m).sum())
        for pose, size_m in zip(poses, sizes_m, strict=True)
    ]
    assert counts.tolist() == expected
    assert min(expected) > 0
    assert count_points_in_boxes(points[:0], poses, sizes_m).tolist() == [0] * 7
    assert count_points_in_boxes(points, poses[:0], sizes_m[:0]).tolist() == []


def test_directions_follow_the_path():
    directions = road_directions(path([0, 1, 2, 3, 4], yaw_rad=0.5))
    expected = torch.tensor([math.cos(0.5), math.sin(0.5), 0], dtype=torch.float64)
    assert torch.allclose(directions, expected.expand_as(directions), atol=1e-9)


def test_standing_car_keeps_its_heading():
    jitter = [0.0, 1e-4, -1e-4, 0.0]
    directions = road_directions(path(jitter, yaw_rad=1.0))
    expected = torch.tensor([math.cos(1.0), math.sin(1.0), 0], dtype=torch.float64)
    assert torch.allclose(directions, expected.expand_as(directions), atol=1e-9)


def test_reversing_car_keeps_left_on_its_left():
    directions = road_directions(path([4, 3, 2, 1, 0]))
    assert (directions[:, 0] > 0.99).all()


def test_left_shift_moves_left_of_the_road():
    pose = torch.eye(4, dtype=torch.float64)
    moved = shift_pose(pose, torch.tensor([1.0, 0, 0]).double(), Shift(lateral_m=2, up_m=1.5))
    assert moved[:3, 3].tolist() == [0.0, 2.0, 1.5]
    assert torch.equal(moved[:3, :3], pose[:3, :3])


def test_vertical_road_is_refused():
    with pytest.raises(ConfigError, match="vertical"):
        shift_pose(torch.eye(4).double(), torch.tensor([0.0, 0, 1]).double(), Shift(lateral_m=1))


def test_shift_names_are_readable():
    assert Shift(lateral_m=-2).name == "right-2m"
    assert Shift(up_m=1.5).name == "up-1.5m"
    assert Shift().name == "recorded"
