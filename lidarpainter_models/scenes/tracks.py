"""Tracks of actors, put together from the boxes of a scene.

Box frame: x along the length, y to the left, z up, origin at the centre.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from lidarpainter_models.geometry.transforms import interpolate_rigid_track


@dataclass(frozen=True, kw_only=True, eq=False)
class ActorTrack:
    """One actor through a log."""

    actor_id: str
    category: str
    is_moving: bool
    """Whether it moves at any time of the log; parked cars are part of the street."""
    size_m: Float[Tensor, "3"]
    """Length, width, height: the medians over its boxes."""
    frame_indices: Int[Tensor, " times"]
    timestamps_ns: Int[Tensor, " times"]
    """Ascending; when each box holds, which is when the LiDAR saw the actor."""
    world_from_box: Float[Tensor, "times 4 4"]
    num_points: Int[Tensor, " times"]
    """LiDAR points in the box, frame by frame."""

    def pose_at(self, timestamp_ns: int) -> Float[Tensor, "4 4"]:
        """`world_from_box` (float64) between its boxes; beyond its ends the end pose holds."""
        return interpolate_rigid_track(self.timestamps_ns, self.world_from_box, timestamp_ns)

    def is_present(self, timestamp_ns: int, margin_ns: int = 50_000_000) -> bool:
        """Whether a time lies between the first and the last box, give or take a margin."""
        first_ns, last_ns = int(self.timestamps_ns[0]), int(self.timestamps_ns[-1])
        return first_ns - margin_ns <= timestamp_ns <= last_ns + margin_ns


def tracks_from_boxes(
    boxes: dict[str, list], world_from_box: Float[Tensor, "boxes 4 4"]
) -> tuple[ActorTrack, ...]:
    """Group the columns of the box table by actor, in the order of first appearance."""
    rows_of: dict[str, list[int]] = {}
    for row, actor_id in enumerate(boxes["actor_id"]):
        rows_of.setdefault(actor_id, []).append(row)
    sizes_m = torch.tensor(
        [boxes["length_m"], boxes["width_m"], boxes["height_m"]], dtype=torch.float64
    ).T
    timestamps_ns = torch.tensor(boxes["timestamp_ns"], dtype=torch.int64)
    frame_indices = torch.tensor(boxes["frame_index"], dtype=torch.int64)
    num_points = torch.tensor(boxes["num_points"], dtype=torch.int64)
    tracks = []
    for actor_id, found in rows_of.items():
        rows = torch.tensor(found)
        rows = rows[torch.argsort(timestamps_ns[rows])]
        tracks.append(
            ActorTrack(
                actor_id=actor_id,
                category=boxes["category"][found[0]],
                is_moving=any(boxes["is_moving"][row] for row in found),
                size_m=sizes_m[rows].median(dim=0).values.to(torch.float32),
                frame_indices=frame_indices[rows],
                timestamps_ns=timestamps_ns[rows],
                world_from_box=world_from_box[rows],
                num_points=num_points[rows],
            )
        )
    return tuple(tracks)
