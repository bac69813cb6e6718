"""Which moving actor holds a point, and where the point is when the actor has moved on.

World: x forward, y left, z up; box frame: x along the length, origin at the centre; metres.
"""

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from lidarpainter_models.geometry.transforms import invert_rigid, transform_points
from lidarpainter_models.scenes.tracks import ActorTrack

BACKGROUND = -1
"""Actor index of a point that no moving box holds."""
MARGIN_M = 0.15  # boxes are grown by this much to the sides and upwards before points are tested
FLOOR_M = 0.1
"""Points lower than this over the bottom of a box are road, unless inside the true box."""


class MovingBoxes:
    """The boxes of all moving actors of a log; poses are kept for every time asked for."""

    def __init__(self, tracks: Sequence[ActorTrack]) -> None:
        """Take the tracks; their order gives the actor indices."""
        self.tracks = tuple(tracks)
        self._poses: dict[tuple[int, int], Tensor | None] = {}

    def pose(self, index: int, timestamp_ns: int) -> Float[Tensor, "4 4"] | None:
        """`world_from_box` (float64) of an actor, None while it is absent."""
        place = (index, timestamp_ns)
        if place not in self._poses:
            track = self.tracks[index]
            is_present = track.is_present(timestamp_ns)
            self._poses[place] = track.pose_at(timestamp_ns).double() if is_present else None
        return self._poses[place]

    def owners(
        self, points_world: Float[Tensor, "points 3"], timestamp_ns: int
    ) -> Int[Tensor, " points"]:
        """Index of the actor that holds each point at a time, or `BACKGROUND`.

        Boxes are grown a little, but not into the road beside and under the actor.
        """
        owners = torch.full(points_world.shape[:1], BACKGROUND, device=points_world.device)
        x_m = points_world[:, 0].contiguous()
        for index, track in enumerate(self.tracks):
            world_from_box = self.pose(index, timestamp_ns)
            if world_from_box is None:
                continue
            half_m = track.size_m.to(points_world) / 2
            reach_m = float(half_m.norm()) + 2 * MARGIN_M
            near = ((x_m - float(world_from_box[0, 3])).abs() <= reach_m).nonzero()[:, 0]
            box_from_world = invert_rigid(world_from_box).to(points_world)
            held = self._holds(transform_points(box_from_world, points_world[near]), half_m)
            owners[near[held]] = index
        return owners

    def moved(
        self,
        points_world: Float[Tensor, "points 3"],
        owners: Int[Tensor, " points"],
        *,
        from_ns: int,
        to_ns: int,
    ) -> tuple[Float[Tensor, "points 3"], Bool[Tensor, " points"]]:
        """Where the points are at another time, and whether their actor is there then."""
        moved = points_world.clone()
        present = torch.ones_like(owners, dtype=torch.bool)
        carried = (owners != BACKGROUND).nonzero()[:, 0]
        for index in owners[carried].unique().tolist():
            rows = carried[owners[carried] == index]
            before, after = self.pose(index, from_ns), self.pose(index, to_ns)
            if before is None or after is None:
                present[rows] = False
                continue
            later_from_world = (after @ invert_rigid(before)).to(points_world)
            moved[rows] = transform_points(later_from_world, points_world[rows])
        return moved, present

    def _holds(
        self, points_box: Float[Tensor, "points 3"], half_m: Float[Tensor, "3"]
    ) -> Bool[Tensor, " points"]:
        over_floor_m = points_box[:, 2] + half_m[2]
        grown = (points_box.abs() <= half_m + MARGIN_M).all(dim=-1)
        inside = (points_box[:, :2].abs() <= half_m[:2]).all(dim=-1) & (over_floor_m > 0)
        return grown & (inside | (over_floor_m > FLOOR_M))
