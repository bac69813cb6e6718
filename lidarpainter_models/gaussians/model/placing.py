"""Gaussians carried from one frame into another: centres, axes, and colours by direction.

Colours that change with direction are spherical harmonics in the axes of a Gaussian's own frame,
so a turn mixes the coefficients of each degree (the Wigner matrices of that degree).
"""

from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from lidarpainter_models.gaussians.model.gaussian_set import GaussianSet
from lidarpainter_models.geometry.transforms import quaternion_from_rotation
from lidarpainter_models.kernels.gaussian_raster.reference import harmonic_basis

_NUM_DIRECTIONS = 64  # any more than 16 in general position determine 16 coefficients


def carried_gaussians(
    gaussians: GaussianSet, target_from_source: Float[Tensor, "4 4"]
) -> GaussianSet:
    """The same Gaussians in another frame, all by one rigid motion; bodies stay as they are."""
    pose = target_from_source.double()
    turn = quaternion_from_rotation(pose[:3, :3])
    columns = gaussians.columns()
    means = columns["means"].double() @ pose[:3, :3].T + pose[:3, 3]
    mixing = harmonic_turn(pose[:3, :3], gaussians.sh_degree)[1:, 1:]
    rest = torch.einsum("jk,gkc->gjc", mixing, columns["sh_rest"].double())
    return replace(
        GaussianSet(**columns),
        means=means.float(),
        rotation_wxyz=_quaternion_product(turn, columns["rotation_wxyz"].double()).float(),
        sh_rest=rest.float(),
    )


def joined_gaussians(parts: Sequence[GaussianSet]) -> GaussianSet:
    """All rows of several sets of one degree, in their order."""
    columns = [part.columns() for part in parts]
    return GaussianSet(**{name: torch.cat([part[name] for part in columns]) for name in columns[0]})


def harmonic_turn(
    target_from_source: Float[Tensor, "3 3"], sh_degree: int
) -> Float[Tensor, "coefficients coefficients"]:
    """Matrix M with c_target = M c_source: the same colours, asked for by turned directions.

    With Y(d) the basis values at a direction, Y(d) M = Y(R^T d) must hold for every d; the matrix
    is solved for at fixed directions, where it is exact but for rounding.
    """
    count = (sh_degree + 1) ** 2
    random = torch.Generator().manual_seed(0)
    directions = torch.randn(_NUM_DIRECTIONS, 3, generator=random, dtype=torch.float64)
    directions = torch.nn.functional.normalize(directions, dim=1)
    here = harmonic_basis(directions, count)
    there = harmonic_basis(directions @ target_from_source.double(), count)
    matrix = torch.linalg.lstsq(here, there).solution
    degree = torch.arange(count, dtype=torch.float64).sqrt().floor()  # 0, 1 1 1, 2 2 2 2 2, ...
    return torch.where(degree[:, None] == degree, matrix, 0.0)


def _quaternion_product(
    first_wxyz: Float[Tensor, "4"], second_wxyz: Float[Tensor, "gaussians 4"]
) -> Float[Tensor, "gaussians 4"]:
    w, x, y, z = first_wxyz
    left = torch.stack(
        [
            torch.stack([w, -x, -y, -z]),
            torch.stack([x, w, -z, y]),
            torch.stack([y, z, w, -x]),
            torch.stack([z, -y, x, w]),
        ]
    )
    return second_wxyz @ left.T
