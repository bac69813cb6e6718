"""What stands around a wet road, for it to mirror: skylines from places all over the ground."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

SPACING_M = 6.0
SECTORS = 24
FARTHEST_M = 80.0
NEAREST_M = 1.0
MOST_OBSTACLES = 20_000
HIGH_SHARE = 0.9
"""A sector is as high as this share of what stands in it."""
CHUNK = 64


@dataclass(frozen=True, kw_only=True, eq=False)
class Skylines:
    """What stands around places, by equal sectors of azimuth from x towards y."""

    of_surface: Int[Tensor, " gaussians"]
    """The place next to each wet surface; -1 for what is not wet."""
    day_light: Float[Tensor, "places sectors 3"]
    """Mean daylight of what stands there."""
    slope: Float[Tensor, "places sectors"]
    """Tangent of its height; 0 under open sky."""


def find_skylines(
    points_world: Float[Tensor, "gaussians 3"],
    day_light: Float[Tensor, "gaussians 3"],
    wet: Float[Tensor, " gaussians"],
    is_obstacle: Float[Tensor, " gaussians"],
) -> Skylines:
    """Skylines of the places where the ground is wet.

    `day_light` is linear; `wet` is above 0 on the ground, `is_obstacle` for what stands on it.
    """
    rows = (wet > 0).nonzero()[:, 0]
    place = (points_world[rows, :2] / SPACING_M).round()
    places, of_row = torch.unique(place, dim=0, return_inverse=True)
    of_surface = points_world.new_full((len(points_world),), -1, dtype=torch.int32)
    of_surface[rows] = of_row.int()
    level = points_world.new_zeros(len(places)).index_add(0, of_row, points_world[rows, 2])
    level = level / torch.bincount(of_row, minlength=len(places)).clamp_min(1)
    obstacles = (is_obstacle > 0).nonzero()[:, 0]
    obstacles = obstacles[:: max(1, math.ceil(len(obstacles) / MOST_OBSTACLES))]
    found = [
        _around(part, points_world[obstacles], day_light[obstacles])
        for part in torch.cat([places * SPACING_M, level[:, None]], dim=1).split(CHUNK)
    ]
    nothing = points_world.new_zeros(0, SECTORS, 4)
    table = torch.cat([nothing, *found])
    return Skylines(of_surface=of_surface, day_light=table[..., :3], slope=table[..., 3])


def _around(
    places: Float[Tensor, "places 3"],
    obstacles: Float[Tensor, "obstacles 3"],
    light: Float[Tensor, "obstacles 3"],
) -> Float[Tensor, "places sectors 4"]:
    """Mean light and height of what stands in each sector."""
    offset = obstacles - places[:, None]
    away_m = offset[..., :2].norm(dim=-1)
    slope = offset[..., 2] / away_m.clamp_min(NEAREST_M)
    counts = ((away_m > NEAREST_M) & (away_m < FARTHEST_M) & (slope > 0)).float()
    weight = counts / away_m.clamp_min(NEAREST_M)  # what is near hides what is behind it
    turn = torch.remainder(torch.atan2(offset[..., 1], offset[..., 0]) / (2 * math.pi), 1)
    sector = (turn * SECTORS).round().long() % SECTORS
    slots = sector + SECTORS * torch.arange(len(places), device=places.device)[:, None]
    total = places.new_zeros(len(places) * SECTORS).index_add(0, slots.flatten(), weight.flatten())
    summed = places.new_zeros(len(places) * SECTORS, 3).index_add(
        0, slots.flatten(), (weight[..., None] * light).flatten(0, 1)
    )
    highest = places.new_zeros(len(places) * SECTORS).scatter_reduce(
        0, slots.flatten(), (slope * counts).flatten(), "amax"
    )
    mean = summed / total.clamp_min(1e-6)[:, None]
    return torch.cat([mean, HIGH_SHARE * highest[:, None]], dim=1).reshape(-1, SECTORS, 4)
