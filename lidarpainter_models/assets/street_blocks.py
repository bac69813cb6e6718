"""A street in blocks: lengths of the driven path with all that stands beside them.

World and block frames: x forward, y left, z up; a block's origin is where the ego was in its
middle, x along the path there; metres.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from lidarpainter_models.gaussians.model.gaussian_set import GaussianSet
from lidarpainter_models.gaussians.model.placing import carried_gaussians
from lidarpainter_models.geometry.driven_paths import DrivenPath
from lidarpainter_models.geometry.trajectory_parts import headed
from lidarpainter_models.geometry.transforms import invert_rigid

BLOCK_M = 20.0
"""Along the path: a crossing, or four parked cars in a row."""
FARTHEST_M = 60.0
"""Beside the path; what is farther is a backdrop, no street."""
LEAST_GAUSSIANS = 100


@dataclass(frozen=True, kw_only=True, eq=False)
class StreetBlock:
    """One length of street."""

    number: int
    """It begins so many block lengths after the first pose of the path."""
    gaussians: GaussianSet
    """Gaussians in the frame of the block."""
    world_from_block: Float[Tensor, "4 4"]
    size_m: Float[Tensor, "3"]
    """What its Gaussians fill, but for the outermost."""


def street_blocks(street: GaussianSet, path: DrivenPath) -> list[StreetBlock]:
    """Cut the Gaussians of a street, in the world, into blocks along a path."""
    ahead_m, beside_m = _along(street.means.detach(), path)
    numbers = (ahead_m / BLOCK_M).floor().long()
    numbers[beside_m > FARTHEST_M] = torch.iinfo(torch.int64).min
    blocks = []
    for number in numbers.unique().tolist():
        rows = (numbers == number).nonzero()[:, 0]
        if len(rows) < LEAST_GAUSSIANS or number == torch.iinfo(torch.int64).min:
            continue
        pose = _middle(path, number)
        gaussians = carried_gaussians(street.select(rows), invert_rigid(pose))
        low, high = (gaussians.means.quantile(share, dim=0) for share in (0.02, 0.98))
        blocks.append(
            StreetBlock(
                number=number, gaussians=gaussians, world_from_block=pose, size_m=high - low
            )
        )
    return blocks


def _along(
    points_world: Float[Tensor, "points 3"], path: DrivenPath
) -> tuple[Float[Tensor, " points"], Float[Tensor, " points"]]:
    """How far along the path, and beside it, points lie; straight on beyond its ends."""
    ahead_m, beside_m = [], []
    way = path.world_from_body[:, :2, 3].float()
    for some in points_world[:, :2].split(50_000):
        nearest: Int[Tensor, " points"] = torch.cdist(some, way).argmin(1)
        offset = some - way[nearest]
        direction = path.directions[nearest, :2].float()
        ahead = (offset * direction).sum(1)
        ahead_m.append(path.travelled_m[nearest].float() + ahead)
        beside_m.append((offset - ahead[:, None] * direction).norm(dim=1))
    return torch.cat(ahead_m), torch.cat(beside_m)


def _middle(path: DrivenPath, number: int) -> Float[Tensor, "4 4"]:
    """The middle of a block: on the path, upright."""
    first = torch.zeros(1, dtype=torch.int64)
    ahead_m = torch.tensor([(number + 0.5) * BLOCK_M], dtype=torch.float64)
    carried = path.moved_along(first, ahead_m)
    direction = carried[0, :3, :3] @ path.directions[0]
    centre = (carried @ path.world_from_body[first])[:, :3, 3]
    return headed(centre, torch.atan2(direction[1], direction[0])[None])[0]
