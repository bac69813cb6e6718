"""Which moving actor holds a point, and where the point is when the actor has moved on.

World: x forward, y left, z up; box frame: x along the length, origin at the centre; metres.
"""

from collections.abc import Sequence
from copy import copy

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from lidarpainter_models.geometry.box_masks import project_boxes
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.geometry.transforms import invert_rigid
from lidarpainter_models.kernels.box_owners import NO_BOX, box_owners
from lidarpainter_models.scenes.tracks import ActorTrack, TrackPoses

BACKGROUND = NO_BOX
"""Actor index of a point that no moving box holds."""
MARGIN_M = 0.15  # boxes are grown by this much to the sides and upwards before points are tested
FLOOR_M = 0.1
"""Points lower than this over the bottom of a box are road, unless inside the true box."""


class MovingBoxes:
    """The boxes of all moving actors of a log."""

    def __init__(self, tracks: Sequence[ActorTrack]) -> None:
        """Take the tracks; their order gives the actor indices."""
        self.tracks = tuple(tracks)
        self._poses = TrackPoses.of(tracks)
        self._size_m = torch.stack([torch.zeros(3), *(track.size_m for track in tracks)])[1:]

    def standing(
        self,
        timestamp_ns: int,
        world_from_box: Float[Tensor, "actors 4 4"],
        is_there: Bool[Tensor, " actors"],
    ) -> "MovingBoxes":
        """The same boxes, which at one time stand elsewhere, or are not there."""
        other = copy(self)
        other._poses = self._poses.standing(timestamp_ns, world_from_box, is_there)
        return other

    def placed(self, timestamp_ns: int) -> list[tuple[ActorTrack, Float[Tensor, "4 4"]]]:
        """The actors that are there at a time, each with its `world_from_box` (float64)."""
        present = self._poses.present(timestamp_ns).tolist()
        poses = self._poses.all_at(timestamp_ns).unbind()
        everybody = zip(present, self.tracks, poses, strict=True)
        return [(track, pose) for is_there, track, pose in everybody if is_there]

    def owners(
        self, points_world: Float[Tensor, "points 3"], timestamp_ns: int
    ) -> Int[Tensor, " points"]:
        """Index of the actor that holds each point at a time, or `BACKGROUND`.

        Boxes are grown a little, but not into the road beside and under the actor: what is lower
        than `FLOOR_M` over the bottom of a box must be inside the true box.
        """
        present = self._poses.present(timestamp_ns).nonzero()[:, 0]
        if not len(present):
            return torch.full(points_world.shape[:1], BACKGROUND, device=points_world.device)
        boxes = box_owners(
            points_world,
            invert_rigid(self._poses.all_at(timestamp_ns)[present]),
            self._size_m[present],
            margin_m=MARGIN_M,
            floor_m=FLOOR_M,
        )
        present = present.to(boxes.device, non_blocking=True)
        return torch.where(boxes == NO_BOX, BACKGROUND, present[boxes])

    def pixels(self, camera: Camera, timestamp_ns: int) -> Bool[Tensor, "height width"]:
        """The pixels in which a box, slightly grown, is seen at a time."""
        present = self._poses.present(timestamp_ns)
        return project_boxes(camera, self._poses.all_at(timestamp_ns), self._size_m, present)

    def moved(
        self,
        points_world: Float[Tensor, "points 3"],
        owners: Int[Tensor, " points"],
        *,
        from_ns: int,
        to_ns: int,
    ) -> tuple[Float[Tensor, "points 3"], Bool[Tensor, " points"]]:
        """Where the points are at another time, and whether their actor is there then."""
        carried = (owners != BACKGROUND).nonzero()[:, 0]
        if not len(carried):
            return points_world, torch.ones_like(owners, dtype=torch.bool)
        before, after = self._poses.all_at(from_ns), self._poses.all_at(to_ns)
        later_from_world = (after @ invert_rigid(before)).to(points_world)[owners[carried]]
        turned = (later_from_world[:, :3, :3] @ points_world[carried, :, None])[..., 0]
        moved = points_world.clone()
        moved[carried] = turned + later_from_world[:, :3, 3]
        present = torch.ones_like(owners, dtype=torch.bool)
        is_there = self._poses.present(from_ns) & self._poses.present(to_ns)
        present[carried] = is_there.to(owners.device, non_blocking=True)[owners[carried]]
        return moved, present
