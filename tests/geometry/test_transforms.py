"""Rigid transforms do what their names say."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from lidarpainter_models.errors import ShapeError
from lidarpainter_models.geometry import transforms

ANGLES = st.floats(-3.1, 3.1)


def random_pose(seed: int) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    tangent = torch.randn(6, generator=generator, dtype=torch.float64)
    return transforms.rigid_from_tangent(tangent)


def test_inverse_undoes_transform():
    world_from_body = random_pose(0)
    identity = transforms.invert_rigid(world_from_body) @ world_from_body
    assert torch.allclose(identity, torch.eye(4, dtype=torch.float64), atol=1e-12)


def test_quarter_turn_about_up_takes_forward_to_left():
    quarter = torch.tensor([0.5**0.5, 0.0, 0.0, 0.5**0.5], dtype=torch.float64)
    rotation = transforms.rotation_from_quaternion(quarter)
    forward = torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64)
    left = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
    assert torch.allclose(rotation @ forward, left, atol=1e-12)


@given(ANGLES, ANGLES, ANGLES)
def test_quaternion_round_trip_keeps_the_rotation(x, y, z):
    rotation = transforms.rotation_from_vector(torch.tensor([x, y, z], dtype=torch.float64))
    again = transforms.rotation_from_quaternion(transforms.quaternion_from_rotation(rotation))
    assert torch.allclose(again, rotation, atol=1e-9)


def test_half_turn_has_a_quaternion():
    rotation = torch.diag(torch.tensor([-1.0, -1.0, 1.0], dtype=torch.float64))
    quaternion = transforms.quaternion_from_rotation(rotation)
    assert torch.allclose(quaternion.abs(), torch.tensor([0.0, 0, 0, 1], dtype=torch.float64))


def test_interpolation_meets_both_ends_and_halves_the_turn():
    first, second = random_pose(1), random_pose(2)
    for fraction, expected in ((0.0, first), (1.0, second)):
        pose = transforms.interpolate_rigid(
            first, second, torch.tensor(fraction, dtype=torch.float64)
        )
        assert torch.allclose(pose, expected, atol=1e-9)
    middle = transforms.interpolate_rigid(first, second, torch.tensor(0.5, dtype=torch.float64))
    step_one = first[:3, :3].T @ middle[:3, :3]
    step_two = middle[:3, :3].T @ second[:3, :3]
    assert torch.allclose(step_one, step_two, atol=1e-9)


def test_track_holds_its_ends_and_interpolates_between():
    poses = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
    poses[1, 0, 3] = 4.0
    times_ns = torch.tensor([100, 200])
    x_at = [
        float(transforms.interpolate_rigid_track(times_ns, poses, t)[0, 3])
        for t in (0, 100, 125, 200, 900)
    ]
    assert x_at == pytest.approx([0, 0, 1, 4, 4])


def test_empty_track_is_refused():
    with pytest.raises(ShapeError, match="0 times"):
        transforms.interpolate_rigid_track(
            torch.zeros(0, dtype=torch.int64), torch.zeros(0, 4, 4, dtype=torch.float64), 5
        )


@pytest.mark.parametrize("fault", ["nan", "scale", "mirror", "perspective"])
def test_faulty_matrix_is_not_rigid(fault):
    matrix = random_pose(3)
    assert bool(transforms.is_rigid(matrix))
    if fault == "nan":
        matrix[0, 3] = float("nan")
    elif fault == "scale":
        matrix[:3, :3] *= 1.01
    elif fault == "mirror":
        matrix[:3, 0] *= -1
    else:
        matrix[3, 0] = 0.1
    assert not bool(transforms.is_rigid(matrix))
