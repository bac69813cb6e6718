"""Which box holds a point in plain torch: the law for the fast version, on any device."""

import math

import torch
from jaxtyping import Float, Int
from torch import Tensor

MOST_PAIRS = 2**24
"""Points times boxes looked at in one go: a few hundred megabytes."""


def box_owners(
    points_m: Float[Tensor, "points 3"],
    box_from_points: Float[Tensor, "boxes 4 4"],
    size_m: Float[Tensor, "boxes 3"],
    margin_m: float,
    floor_m: float,
) -> Int[Tensor, " points"]:
    """See `box_owners.box_owners`."""
    parts = max(1, math.ceil(points_m.shape[0] * len(size_m) / MOST_PAIRS))
    found = [
        _owners(part, box_from_points, size_m / 2, margin_m, floor_m)
        for part in points_m.tensor_split(parts)
    ]
    return torch.cat(found)


def _owners(
    points_m: Float[Tensor, "points 3"],
    box_from_points: Float[Tensor, "boxes 4 4"],
    half_m: Float[Tensor, "boxes 3"],
    margin_m: float,
    floor_m: float,
) -> Int[Tensor, " points"]:
    """All points against all boxes."""
    rotation, translation = box_from_points[:, :3, :3], box_from_points[:, :3, 3]
    points_box = torch.einsum("bij,pj->bpi", rotation, points_m) + translation[:, None]
    over_floor_m = points_box[..., 2] + half_m[:, None, 2]
    grown = (points_box.abs() <= half_m[:, None] + margin_m).all(dim=-1)
    inside = (points_box[..., :2].abs() <= half_m[:, None, :2]).all(dim=-1) & (over_floor_m > 0)
    is_held = grown & (inside | (over_floor_m > floor_m))
    number = torch.arange(1, len(half_m) + 1, device=points_m.device)[:, None]
    none = number.new_zeros(1, points_m.shape[0])
    return torch.cat([none, is_held * number]).amax(dim=0) - 1
