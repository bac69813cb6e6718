"""Which box holds a point in plain torch: the law for the fast version, on any device."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from lidarpainter_models.geometry.transforms import transform_points


def box_owners(
    points_m: Float[Tensor, "points 3"],
    box_from_points: Float[Tensor, "boxes 4 4"],
    size_m: Float[Tensor, "boxes 3"],
    margin_m: float,
    floor_m: float,
) -> Int[Tensor, " points"]:
    """See `box_owners.box_owners`."""
    owners = torch.full(points_m.shape[:1], -1, device=points_m.device)
    for index, half_m in enumerate(size_m / 2):
        points_box = transform_points(box_from_points[index], points_m)
        over_floor_m = points_box[:, 2] + half_m[2]
        grown = (points_box.abs() <= half_m + margin_m).all(dim=-1)
        inside = (points_box[:, :2].abs() <= half_m[:2]).all(dim=-1) & (over_floor_m > 0)
        owners[grown & (inside | (over_floor_m > floor_m))] = index
    return owners
