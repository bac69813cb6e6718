"""Returns that nothing around them confirms: rain, snow and spray in the air.

From where a LiDAR stands the beams around a return meet the same surface, pole or wire: a part of
them ends at about its range. Drops stop each beam at a range of its own. Charron et al. (2018,
"De-noising of Lidar Point Clouds Corrupted by Snowfall") count neighbours within a radius that
grows with range; here they are counted as a share of the returns in the directions around, which
depends neither on how many beams a LiDAR has nor on how many of them return.
"""

import math

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from lidarpainter_models.scenes.driving_scene import DrivingScene
from lidarpainter_models.scenes.records import Sweep

WEATHER_REACH_M = 40.0
"""No drop returns enough light from further away, where what is thin stands alone."""
CELL_RAD, LARGEST_CELL_RAD = math.radians(1.0), math.radians(4.0)
"""Directions and ranges fall into cells; what lies in a cell and those beside it is around. Cells
are doubled up to the larger size until as many returns lie around most as `FEW_AROUND`: a LiDAR of
few beams is judged by its own spacing, and a turn that is sparser still tells nothing."""
FEW_AROUND = 12
LEAST_AROUND = 7
"""Among fewer in the directions around a return below the LiDAR tells nothing: the road was sampled
sparsely there, as in clouds that were thinned to one spacing in metres. Above, where most beams
meet nothing, drops have nothing around."""
CELL_RANGE = 0.03
"""As a share of the range."""
LEAST_SHARE = 0.03
"""Of the other returns around, those that must end at about the same range; one at the least."""
LEAST_RETURNS = 200
"""A turn of fewer tells nothing."""
LEAST_ALONE, MOST_ALONE = 0.01, 0.5
"""Of the returns from where drops return, the part that stands alone in rain. Where it is less the
air is clear, and all of it is real: 0.2 to 0.5 % of four recordings in clear air, 2.2 to 2.4 % of
three with 2 % of their returns made drops. Left out they cost PandaSet 1.1 dB on the road ahead of
its frames (three seeds). Where it is more the turn is too sparse to tell drops."""

_BESIDE = (-1, 0, 1)


def confirmed_returns(
    scene: DrivingScene, sweep: Sweep
) -> tuple[Float[Tensor, "points 3"], Int[Tensor, " points"]]:
    """What a sweep met, in the world, and when; without drops."""
    xyz_m = scene.read_column(sweep, "xyz_m")
    kept = is_confirmed(xyz_m - sweep.world_from_lidar[:3, 3].to(xyz_m))
    return xyz_m[kept], scene.measured_ns(sweep)[kept]


def is_confirmed(offset_m: Float[Tensor, "points 3"]) -> Bool[Tensor, " points"]:
    """Which returns of a turn are no drops, by where they lie from the LiDAR (z up).

    All of them, unless as many stand alone as do in rain.
    """
    is_lone = stands_alone(offset_m)
    num_near = (offset_m.norm(dim=1) <= WEATHER_REACH_M).sum()
    is_rain = LEAST_ALONE * num_near <= is_lone.sum() <= MOST_ALONE * num_near
    return ~(is_lone & is_rain)


def stands_alone(offset_m: Float[Tensor, "points 3"]) -> Bool[Tensor, " points"]:
    """Which returns of a turn nothing around confirms, from where drops return."""
    range_m = offset_m.norm(dim=1).clamp(min=1e-3)
    if len(range_m) < LEAST_RETURNS:
        return torch.zeros_like(range_m, dtype=torch.bool)
    cell_rad = CELL_RAD
    while cell_rad <= LARGEST_CELL_RAD:
        is_alone, around = _alone_among_cells(offset_m, range_m, cell_rad)
        is_alone &= range_m <= WEATHER_REACH_M
        is_sparse = is_alone.sum() > MOST_ALONE * (range_m <= WEATHER_REACH_M).sum()
        if is_sparse:
            return is_alone
        if around.median() >= FEW_AROUND:
            return is_alone & ((around >= LEAST_AROUND) | (offset_m[:, 2] >= 0))
        cell_rad *= 2
    return torch.zeros_like(is_alone)


def _alone_among_cells(
    offset_m: Float[Tensor, "points 3"], range_m: Float[Tensor, " points"], cell_rad: float
) -> tuple[Bool[Tensor, " points"], Int[Tensor, " points"]]:
    """Which returns nothing around confirms, and how many others there are around each."""
    num_columns, num_rows = round(2 * math.pi / cell_rad), round(math.pi / cell_rad) + 2
    turn = torch.atan2(offset_m[:, 1], offset_m[:, 0]) + math.pi
    rise = torch.asin((offset_m[:, 2] / range_m).clamp(-1, 1)) + math.pi / 2
    direction = (turn / cell_rad).long() % num_columns * num_rows + (rise / cell_rad).long() + 1
    layer = ((range_m / range_m.min()).log() / CELL_RANGE).long() + 1
    layers = int(layer.max()) + 2
    cells, of_point, count = torch.unique(
        direction * layers + layer, return_inverse=True, return_counts=True
    )
    directions, of_cell = torch.unique(cells // layers, return_inverse=True)
    count_in = torch.zeros_like(directions).index_add_(0, of_cell, count)
    near, around = -torch.ones_like(count), -torch.ones_like(count)  # but for the return itself
    for step in (right * num_rows + up for right in _BESIDE for up in _BESIDE):
        looked_at = (directions + step) % (num_columns * num_rows)
        around += _counted(directions, count_in, looked_at)[of_cell]
        there = looked_at[of_cell] * layers + cells % layers
        for further in _BESIDE:
            near += _counted(cells, count, there + further)
    return ((near < 1) | (near < LEAST_SHARE * around))[of_point], around[of_point]


def _counted(
    cells: Int[Tensor, " cells"], count: Int[Tensor, " cells"], wanted: Int[Tensor, " wanted"]
) -> Int[Tensor, " wanted"]:
    """How many lie in each cell that is asked for; those that have any are sorted."""
    place = torch.searchsorted(cells, wanted).clamp(max=len(cells) - 1)
    return torch.where(cells[place] == wanted, count[place], 0)
