"""Gaussians carried into another frame look the same from there."""

from dataclasses import replace

import pytest
import torch
from gaussian_world import camera_at
from random_gaussians import random_gaussians

from lidarpainter_models.gaussians.model.drawing import camera_from_body, draw_gaussians
from lidarpainter_models.gaussians.model.placing import (
    carried_gaussians,
    harmonic_turn,
    joined_gaussians,
)
from lidarpainter_models.geometry.transforms import rigid_from_rotation, rotation_from_vector
from lidarpainter_models.kernels.gaussian_raster.reference import harmonic_basis

TURN = rotation_from_vector(torch.tensor([0.3, -1.1, 2.0], dtype=torch.float64))
POSE = rigid_from_rotation(TURN, torch.tensor([3.0, -2.0, 0.5], dtype=torch.float64))
NOBODY = torch.zeros(0, dtype=torch.float64)


@pytest.mark.parametrize("sh_degree", [0, 1, 2, 3])
def test_turned_harmonics_have_the_same_value_at_turned_directions(sh_degree):
    count = (sh_degree + 1) ** 2
    random = torch.Generator().manual_seed(1)
    coefficients = torch.randn(count, generator=random, dtype=torch.float64)
    directions = torch.randn(100, 3, generator=random, dtype=torch.float64)
    directions = torch.nn.functional.normalize(directions, dim=1)
    before = harmonic_basis(directions, count) @ coefficients
    turned = harmonic_turn(TURN, sh_degree) @ coefficients
    after = harmonic_basis(directions @ TURN.T, count) @ turned
    torch.testing.assert_close(after, before, atol=1e-12, rtol=0)


def test_turns_mix_no_degree_with_another_and_keep_lengths():
    matrix = harmonic_turn(TURN, 3)
    identity = torch.eye(16, dtype=torch.float64)
    torch.testing.assert_close(matrix @ matrix.T, identity, atol=1e-12, rtol=0)
    assert float(matrix[1:4, 4:].abs().max()) == 0


def test_what_is_carried_looks_the_same_to_a_camera_that_is_carried_along():
    gaussians = random_gaussians(80, 3, seed=4)
    gaussians = replace(gaussians, means=gaussians.means * 0.05 + torch.tensor([6.0, 0.0, 1.0]))
    camera = camera_at(0.0)

    def drawn(some, pose):
        bodies = camera_from_body(pose, torch.zeros(0, 4, 4, dtype=torch.float64), NOBODY)
        return draw_gaussians(some, bodies, camera).rgb

    here = drawn(gaussians, camera.world_from_camera)
    there = drawn(carried_gaussians(gaussians, POSE), POSE @ camera.world_from_camera)
    assert float(here.std()) > 0.05
    torch.testing.assert_close(there, here, atol=1e-4, rtol=0)  # float32 at 6 m


def test_joined_sets_stand_one_behind_the_other():
    parts = [random_gaussians(3, 1, seed=1), random_gaussians(4, 1, seed=2)]
    joined = joined_gaussians(parts)
    assert len(joined) == 7
    assert torch.equal(joined.sh_rest[3:], parts[1].sh_rest)
