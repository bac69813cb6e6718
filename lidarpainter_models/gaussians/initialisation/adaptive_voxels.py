"""Thin out point clouds so that voxels lie where images gain most by them.

A voxel's size follows a spacing that is asked for at each point: near things get small voxels, far
ones large. Sizes are powers of two times a factor that is searched so that a given number of
voxels comes out. Metres; world or box frame alike.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields

import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from lidarpainter_models.lidar.lidar_map import MapPoints

MOST_M = 2.0
"""The largest edge of a voxel."""
POINTS_AT_ONCE = 1 << 18
"""Points that are copied to float64 at a time: copies of all take more than the points."""


@dataclass(frozen=True, kw_only=True, eq=False)
class VoxelPoints:
    """One point per occupied voxel."""

    xyz_m: Float[Tensor, "voxels 3"]
    """Mean of the points inside."""
    rgb: Float[Tensor, "voxels 3"]
    """Mean colour of the coloured points inside."""
    has_colour: Bool[Tensor, " voxels"]
    size_m: Float[Tensor, " voxels"]
    """Edge of the voxel."""
    num_points: Int[Tensor, " voxels"]
    """How many points lie inside."""

    def keep(self, kept: Bool[Tensor, " voxels"]) -> "VoxelPoints":
        """The marked voxels."""
        return type(self)(**{field.name: getattr(self, field.name)[kept] for field in fields(self)})


def voxel_keys(
    xyz_m: Float[Tensor, "points 3"], size_m: Float[Tensor, " points"]
) -> Int[Tensor, " points"]:
    """A number per point, equal exactly for points in the same voxel of the same size.

    Collisions of the 63-bit mix are possible and harmless: two far voxels would share a mean.
    """
    keys = torch.empty(len(xyz_m), dtype=torch.int64)
    parts = (column.split(POINTS_AT_ONCE) for column in (keys, xyz_m, size_m))
    for key, xyz, size in zip(*parts, strict=True):
        cell = torch.floor(xyz.double() / size.double()[:, None]).long()
        level = torch.round(torch.log2(size.double()) * 8).long()
        key.copy_((cell[:, 0] * 73_856_093) ^ (cell[:, 1] * 19_349_669_117))
        key ^= (cell[:, 2] * 83_492_791_363) ^ (level * 2_654_435_761_123)
    return keys


@dataclass(frozen=True, kw_only=True, eq=False)
class Cloud:
    """Points of one body, to be thinned out."""

    xyz_m: Float[Tensor, "points 3"]
    rgb_u8: UInt8[Tensor, "points 3"]
    has_colour: Bool[Tensor, " points"]
    """Which of the colours mean anything."""
    spacing_m: Float[Tensor, " points"]
    """Spacing that is asked for at each point, up to a factor for all."""
    least_m: float = 0.03
    """Smallest edge of a voxel."""

    @classmethod
    def of(
        cls,
        points: MapPoints,
        spacing_m: Float[Tensor, " points"],
        chosen: Bool[Tensor, " points"],
        least_m: float,
    ) -> "Cloud":
        """The chosen ones of some points."""
        return cls(
            xyz_m=points.xyz_m[chosen],
            rgb_u8=points.rgb_u8[chosen],
            has_colour=points.has_colour[chosen],
            spacing_m=spacing_m[chosen],
            least_m=least_m,
        )

    def sizes(self, factor: float) -> Float[Tensor, " points"]:
        """Voxel edge of each point: about `factor` spacings, as a power of two times the least."""
        wanted = (self.spacing_m * factor).clamp(self.least_m, MOST_M)
        return self.least_m * 2 ** torch.floor(torch.log2(wanted / self.least_m) + 0.5)


def adaptive_voxels(clouds: Sequence[Cloud], *, budget: int) -> list[VoxelPoints]:
    """At most `budget` voxels of all clouds, of the smallest size that allows.

    A spacing asks for the same detail on whatever body. Fewer come out if the clouds are smaller.
    """

    def count(factor: float) -> int:
        return sum(_num_unique(voxel_keys(one.xyz_m, one.sizes(factor))) for one in clouds)

    low, high = 0.25, 1024.0
    best = low
    if count(low) > budget:
        for _ in range(9):
            middle = (low * high) ** 0.5
            low, high = (low, middle) if count(middle) <= budget else (middle, high)
        best = high
    voxels = [mean_by_voxel(cloud, cloud.sizes(best)) for cloud in clouds]
    share = budget / max(sum(part.size_m.numel() for part in voxels), 1)
    return voxels if share >= 1 else [_evenly_chosen(part, share) for part in voxels]


def _num_unique(keys: Int[Tensor, " points"]) -> int:
    """How many different keys there are; sorts them in place, as `torch.unique` would a copy."""
    keys.numpy().sort()
    return int((keys[1:] != keys[:-1]).sum()) + min(len(keys), 1)


def _evenly_chosen(voxels: VoxelPoints, share: float) -> VoxelPoints:
    """An even choice of them, where even the largest voxels are too many."""
    count = voxels.size_m.numel()
    places = (torch.arange(int(count * share)) / share).long()
    chosen = torch.zeros(count, dtype=torch.bool)
    chosen[places] = True
    return voxels.keep(chosen)


def mean_by_voxel(cloud: Cloud, size_m: Float[Tensor, " points"]) -> VoxelPoints:
    """Average points and colours inside every voxel."""
    unique, voxel = torch.unique(voxel_keys(cloud.xyz_m, size_m), return_inverse=True)
    count = torch.bincount(voxel, minlength=unique.numel())
    coloured = torch.bincount(voxel[cloud.has_colour], minlength=unique.numel())
    xyz = torch.zeros(unique.numel(), 3, dtype=torch.float64)
    colour = torch.zeros(unique.numel(), 3, dtype=torch.float64)
    columns = (voxel, cloud.xyz_m, cloud.rgb_u8, cloud.has_colour)
    for own, place, seen, has in zip(*(c.split(POINTS_AT_ONCE) for c in columns), strict=True):
        xyz.index_add_(0, own, place.double())
        colour.index_add_(0, own[has], (seen[has].float() / 255).double())
    edge = torch.zeros(unique.numel()).scatter_reduce(0, voxel, size_m, reduce="amax")
    return VoxelPoints(
        xyz_m=(xyz / count[:, None]).float(),
        rgb=(colour / coloured.clamp(min=1)[:, None]).float(),
        has_colour=coloured > 0,
        size_m=edge,
        num_points=count,
    )
