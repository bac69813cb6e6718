"""Height of the ground on a grid, from the points of the street.

World frame, z up, metres. In each cell it is a low quantile of the points' z: low, because what
stands on the ground is higher; a quantile, because a few returns lie below the ground (reflections
in glass and water).
"""

import torch
from jaxtyping import Float, Int
from torch import Tensor

NEIGHBOURS = 24
OUTLIER_M = 0.2
CELL_M, QUANTILE = 1.0, 0.1


class GroundHeights:
    """Looks up the ground under a place; where no point fell it is unknown (NaN)."""

    def __init__(self, xyz_m: Float[Tensor, "points 3"], *, least_points: int = 4) -> None:
        """Sort points into square cells and take a quantile of each cell with enough of them."""
        keys = self._keys(xyz_m[:, :2])
        by_height = torch.argsort(xyz_m[:, 2])
        order = by_height[torch.argsort(keys[by_height], stable=True)]
        self._cells, counts = torch.unique_consecutive(keys[order], return_counts=True)
        starts = counts.cumsum(0) - counts
        low = order[starts + (QUANTILE * (counts - 1)).long()]
        self._height_m = torch.where(counts >= least_points, xyz_m[low, 2], torch.nan)

    def at(self, xy_m: Float[Tensor, "points 2"]) -> Float[Tensor, " points"]:
        """Ground z below or above each place, NaN where it is unknown."""
        if self._cells.numel() == 0:
            return torch.full_like(xy_m[:, 0], torch.nan)
        keys = self._keys(xy_m)
        found = torch.searchsorted(self._cells, keys).clamp(max=self._cells.numel() - 1)
        is_known = self._cells[found] == keys
        return torch.where(is_known, self._height_m[found].to(xy_m), torch.nan)

    def around(self, xy_m: Float[Tensor, "points 2"]) -> Float[Tensor, " points"]:
        """Ground z interpolated from the nearest known cells; NaN only if none is known.

        Of these, cells that rise over their lower quartile hold no ground (a car's bumper).
        """
        has_height = ~self._height_m.isnan()
        known_m = self._height_m[has_height].float()
        if known_m.numel() == 0 or xy_m.shape[0] == 0:
            return torch.full_like(xy_m[:, 0], torch.nan)
        from scipy.spatial import cKDTree  # a third of a second, for who only reads settings

        tree = cKDTree(self._centres(self._cells[has_height]).numpy())
        count = min(NEIGHBOURS, known_m.numel())
        distance_m, nearest = tree.query(xy_m.numpy(), k=[*range(1, count + 1)])
        z = known_m[torch.from_numpy(nearest)]
        is_ground = z <= z.quantile(0.25, dim=1, keepdim=True) + OUTLIER_M
        weight = is_ground / (torch.from_numpy(distance_m).float() + 0.1 * CELL_M) ** 2
        return (weight * z).sum(dim=1) / weight.sum(dim=1)

    def _centres(self, cells: Int[Tensor, " cells"]) -> Float[Tensor, "cells 2"]:
        row = (cells + (1 << 30)) % (1 << 31) - (1 << 30)
        column = (cells - row) // (1 << 31)
        return (torch.stack([column, row], dim=1).float() + 0.5) * CELL_M

    def _keys(self, xy_m: Float[Tensor, "points 2"]) -> Tensor:
        column, row = (xy_m / CELL_M).floor().long().unbind(-1)
        return column * (1 << 31) + row
