"""Where the ground is, by cells of the street's Gaussians: what rain wets and beams graze."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

CELL_M = 1.0
LOW_SHARE = 0.2
"""The ground of a cell lies where so many of its Gaussians are below."""
GROUND_HEIGHT_M = 0.25
"""Surfaces up to this height are ground."""
TOLERANCE_M, RISE = 0.6, 0.08
"""How far ground may be off the road's level, beside it and per metre away."""
LEAST_OPACITY = 0.3
MOST_CELLS = 4_000_000


@dataclass(frozen=True, kw_only=True, eq=False)
class Ground:
    """Heights of the ground in level cells."""

    corner: Float[Tensor, "2"]
    height_m: Float[Tensor, "rows columns"]
    """World z; infinitely deep where there is no ground."""

    def cells(self, points_world: Float[Tensor, "points 3"]) -> Int[Tensor, " points"]:
        """The cell over or under each point, the nearest if it lies beside all."""
        rows, columns = self.height_m.shape
        place = ((points_world[:, :2] - self.corner) / CELL_M).floor().long()
        return place[:, 0].clamp(0, rows - 1) * columns + place[:, 1].clamp(0, columns - 1)

    def share(self, points_world: Float[Tensor, "points 3"]) -> Float[Tensor, " points"]:
        """How far each point counts as ground: 1 on it, 0 from `GROUND_HEIGHT_M` on."""
        above = points_world[:, 2] - self.height_m.flatten()[self.cells(points_world)]
        return (2 - 2 * above.abs() / GROUND_HEIGHT_M).clamp(0, 1)


def find_ground(
    points_world: Float[Tensor, "points 3"],
    opacity: Float[Tensor, " points"],
    road: Float[Tensor, "frames 3"],
) -> Ground:
    """The low surfaces that continue the road.

    `points_world` are centres of the street's Gaussians, `road` points of the road that was driven.
    """
    margin_m = 80.0
    low, high = road[:, :2].amin(dim=0) - margin_m, road[:, :2].amax(dim=0) + margin_m
    rows, columns = (max(int(size), 1) for size in ((high - low) / CELL_M).ceil())
    if rows * columns > MOST_CELLS:  # a long drive: what lies beside all of it is left out
        high = low + (high - low) * (MOST_CELLS / (rows * columns)) ** 0.5
        rows, columns = (max(int(size), 1) for size in ((high - low) / CELL_M).ceil())
    deep = points_world.new_full((rows * columns,), -torch.inf)
    ground = Ground(corner=low, height_m=deep.reshape(rows, columns))
    is_inside = ((points_world[:, :2] >= low) & (points_world[:, :2] < high)).all(dim=1)
    points = points_world[is_inside & (opacity > LEAST_OPACITY)]
    if not len(points):
        return ground
    occupied, counts, heights = _low_heights(ground.cells(points), points[:, 2])
    is_level = _continues_road(occupied, heights, ground, road) & (counts > 1)
    deep[occupied[is_level]] = heights[is_level]
    return ground


def _low_heights(
    cells: Int[Tensor, " points"], z: Float[Tensor, " points"]
) -> tuple[Int[Tensor, " cells"], Int[Tensor, " cells"], Float[Tensor, " cells"]]:
    """Occupied cells, how many points each holds, and a low height of them."""
    by_height = torch.argsort(z)
    by_cell = torch.argsort(cells[by_height], stable=True)
    order = by_height[by_cell]
    occupied, counts = torch.unique_consecutive(cells[order], return_counts=True)
    first = counts.cumsum(0) - counts
    return occupied, counts, z[order[first + (LOW_SHARE * counts).long()]]


def _continues_road(
    cells: Int[Tensor, " cells"],
    heights: Float[Tensor, " cells"],
    ground: Ground,
    road: Float[Tensor, "frames 3"],
) -> Bool[Tensor, " cells"]:
    """Whether the low surface of a cell is about as high as the nearest road."""
    columns = ground.height_m.shape[1]
    xy = torch.stack([cells // columns, cells % columns], dim=1).to(heights) + 0.5
    away = torch.cdist(xy * CELL_M + ground.corner, road[:, :2].to(heights))
    nearest_m, frame = away.min(dim=1)
    off_m = (heights - road[frame, 2].to(heights)).abs()
    return off_m < TOLERANCE_M + RISE * nearest_m
