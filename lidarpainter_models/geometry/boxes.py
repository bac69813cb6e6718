"""Oriented boxes of actors.

Box frame: x along the length, y to the left, z up, origin at the centre; sizes are (length,
width, height) in metres.
"""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from lidarpainter_models.geometry.transforms import invert_rigid, transform_points

BOX_EDGES = tuple((i, i + step) for step in (1, 2, 4) for i in range(8) if not i & step)
"""Pairs of the corners that `box_corners` gives: those that differ in one axis."""


def is_inside_box(
    points_world: Float[Tensor, "points 3"],
    world_from_box: Float[Tensor, "4 4"],
    size_m: Float[Tensor, "3"],
    *,
    margin_m: float = 0.0,
) -> Bool[Tensor, " points"]:
    """Which points lie in the box, grown by `margin_m` on every side."""
    box_from_world = invert_rigid(world_from_box).to(points_world)
    points_box = transform_points(box_from_world, points_world)
    half_m = size_m.to(points_world) / 2 + margin_m
    return (points_box.abs() <= half_m).all(dim=-1)


def count_points_in_boxes(
    points_world: Float[Tensor, "points 3"],
    world_from_boxes: Float[Tensor, "boxes 4 4"],
    sizes_m: Float[Tensor, "boxes 3"],
) -> Int[Tensor, " boxes"]:
    """How many of the points lie in each box; sorts the points once for all boxes."""
    sorted_m = points_world[torch.argsort(points_world[:, 0])]
    reach_m = sizes_m.double().norm(dim=1) / 2
    ends_m = world_from_boxes[:, 0, 3].double()[:, None] + torch.stack([-reach_m, reach_m], dim=1)
    rows = torch.searchsorted(sorted_m[:, 0].contiguous(), ends_m.to(sorted_m))
    counts = [
        int(is_inside_box(sorted_m[first:last], pose, size_m).sum())
        for (first, last), pose, size_m in zip(
            rows.tolist(), world_from_boxes, sizes_m, strict=True
        )
    ]
    return torch.tensor(counts, dtype=torch.int64)


def box_corners(size_m: Float[Tensor, "3"]) -> Float[Tensor, "8 3"]:
    """The eight corners in the box frame; x varies slowest, z fastest."""
    signs = torch.cartesian_prod(*[torch.tensor([-0.5, 0.5], dtype=size_m.dtype)] * 3)
    return signs * size_m


def first_box_hit(
    origin_world: Float[Tensor, "3"],
    direction_world: Float[Tensor, "3"],
    world_from_boxes: Float[Tensor, "boxes 4 4"],
    sizes_m: Float[Tensor, "boxes 3"],
) -> int | None:
    """The box that a ray enters first, by slabs (Kay and Kajiya, 1986); None if it meets none.

    A box around the origin counts as entered at once.
    """
    if len(sizes_m) == 0:
        return None
    box_from_world = invert_rigid(world_from_boxes.double())
    rotation, translation = box_from_world[:, :3, :3], box_from_world[:, :3, 3]
    origin = rotation @ origin_world.double() + translation
    direction = rotation @ direction_world.double()
    half_m = sizes_m.double() / 2
    safe = torch.where(direction.abs() < 1e-12, torch.full_like(direction, 1e-12), direction)
    ends = torch.stack([(-half_m - origin) / safe, (half_m - origin) / safe])
    enters, leaves = ends.amin(0).amax(1).clamp(min=0), ends.amax(0).amin(1)
    distance = torch.where(enters <= leaves, enters, torch.inf)
    nearest = int(distance.argmin())
    return nearest if bool(distance[nearest].isfinite()) else None
