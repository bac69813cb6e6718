"""Tracks of actors, put together from the boxes of a scene.

Box frame: x along the length, y to the left, z up, origin at the centre.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import TypeVar

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from lidarpainter_models.geometry.transforms import interpolate_rigid, interpolate_rigid_track

PRESENCE_MARGIN_NS = 50_000_000
"""An actor is there for half a 10 Hz frame before its first and after its last box."""

LONGEST_GAP_NS = 1_050_000_000
"""Frames without a box of an actor are bridged for a second; in longer gaps it is away.

Data sets give an actor that was out of sight and came back its old id (nuScenes does); who was
behind something for a moment is still there."""

MOVING_M = 1.0
"""An actor that gets so far from its first box moves; a parked car's boxes jitter by less."""


MOST_TIMES = 10_000
"""At which poses are kept: all of a log, and not all that a simulator asks for in days."""
Made = TypeVar("Made")


def remembered(known: dict[int, Made], timestamp_ns: int, make: Callable[[], Made]) -> Made:
    """What is known of a time, or what is made of it; several threads may ask."""
    found = known.get(timestamp_ns)
    if found is None:
        if len(known) >= MOST_TIMES:
            known.clear()
        found = known[timestamp_ns] = make()
    return found


def does_move(centres_m: Float[Tensor, "times 3"]) -> bool:
    """Whether the centres of an actor's boxes, all of a log, are those of one that moves."""
    return bool(((centres_m - centres_m[0]).norm(dim=1) >= MOVING_M).any())


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
    """Ascending, each once; when each box holds, which is when the LiDAR saw the actor."""
    world_from_box: Float[Tensor, "times 4 4"]
    num_points: Int[Tensor, " times"]
    """LiDAR points in the box, frame by frame."""

    def pose_at(self, timestamp_ns: int) -> Float[Tensor, "4 4"]:
        """`world_from_box` (float64) between its boxes; beyond its ends the end pose holds."""
        return interpolate_rigid_track(self.timestamps_ns, self.world_from_box, timestamp_ns)

    @property
    def middle_pose(self) -> Float[Tensor, "4 4"]:
        """`world_from_box` (float64) of the middle one of its boxes: where a parked actor stands.

        Boxes of one that stands differ by how well they were drawn.
        """
        return self.world_from_box[len(self.world_from_box) // 2].double()

    def is_present(self, timestamp_ns: int, margin_ns: int = PRESENCE_MARGIN_NS) -> bool:
        """Whether the actor is there at a time; see `TrackPoses.present`."""
        return bool(TrackPoses.of([self]).present(timestamp_ns, margin_ns)[0])


@dataclass(frozen=True, eq=False)
class TrackPoses:
    """The poses of many tracks, asked for all at once; rows are the tracks in their order."""

    timestamps_ns: Int[Tensor, "tracks times"]
    """Ascending; a shorter track repeats its last time."""
    world_from_box: Float[Tensor, "tracks times 4 4"]
    """float64."""
    is_bridged: Bool[Tensor, "tracks gaps"]
    """Whether the actor is there between a box and the next one."""
    _at: dict[int, Float[Tensor, "tracks 4 4"]] = field(
        default_factory=dict, init=False, repr=False
    )
    """What was asked for: every view asks for the times of all its sources."""
    _present_at: dict[int, Bool[Tensor, " tracks"]] = field(
        default_factory=dict, init=False, repr=False
    )
    """Who is there at times at which it is said."""

    @classmethod
    def of(cls, tracks: Sequence[ActorTrack]) -> "TrackPoses":
        """Take the tracks as they are."""
        if not tracks:
            none = torch.zeros(0, 1, dtype=torch.int64)
            poses = torch.zeros(0, 1, 4, 4, dtype=torch.float64)
            return cls(none, poses, torch.zeros(0, 0, dtype=torch.bool))
        times_ns = pad_sequence([track.timestamps_ns for track in tracks], batch_first=True)
        poses = pad_sequence([track.world_from_box.double() for track in tracks], batch_first=True)
        counts = torch.tensor([len(track.timestamps_ns) for track in tracks])
        last = torch.minimum(torch.arange(times_ns.shape[1]), counts[:, None] - 1)
        rows = torch.arange(len(tracks))[:, None]
        frames = pad_sequence([track.frame_indices for track in tracks], batch_first=True)
        times_ns, skipped = times_ns[rows, last], frames[rows, last].diff() > 1
        is_bridged = ~(skipped & (times_ns.diff() > LONGEST_GAP_NS))
        return cls(times_ns, poses[rows, last], is_bridged)

    def __len__(self) -> int:
        return self.timestamps_ns.shape[0]

    def standing(
        self,
        timestamp_ns: int,
        world_from_box: Float[Tensor, "tracks 4 4"],
        is_there: Bool[Tensor, " tracks"],
    ) -> "TrackPoses":
        """The same tracks, which at one time stand elsewhere, or are not there."""
        other = replace(self)
        other._at[timestamp_ns] = world_from_box
        other._present_at[timestamp_ns] = is_there
        return other

    def present(
        self, timestamp_ns: int | Tensor, margin_ns: int = PRESENCE_MARGIN_NS
    ) -> Bool[Tensor, " *tracks"]:
        """Whether each track is there at a time; times (queries, 1) give (queries, tracks).

        An actor is there from a box to the next, unless frames without one lie between them for
        longer than a second, and for a margin before and after a box.
        """
        if self._present_at and isinstance(timestamp_ns, int) and timestamp_ns in self._present_at:
            return self._present_at[timestamp_ns]
        first_ns, last_ns = self.timestamps_ns[:, 0], self.timestamps_ns[:, -1]
        there = (first_ns - margin_ns <= timestamp_ns) & (timestamp_ns <= last_ns + margin_ns)
        if bool(self.is_bridged.all()):
            return there
        for row, gap in (~self.is_bridged).nonzero().tolist():
            left_ns, back_ns = self.timestamps_ns[row, gap : gap + 2].tolist()
            is_away = (left_ns + margin_ns < timestamp_ns) & (timestamp_ns < back_ns - margin_ns)
            there[..., row : row + 1] &= ~torch.as_tensor(is_away)
        return there

    def at(
        self, rows: Int[Tensor, " queries"], times_ns: Int[Tensor, " queries"]
    ) -> Float[Tensor, "queries 4 4"]:
        """Poses of some tracks, each at its time; see `ActorTrack.pose_at`."""
        known_ns = self.timestamps_ns[rows]
        inside_ns = times_ns.clamp(known_ns[:, 0], known_ns[:, -1])
        after = torch.searchsorted(known_ns, inside_ns[:, None])[:, 0].clamp(min=1)
        after = after.clamp(max=known_ns.shape[1] - 1)
        before = (after - 1).clamp(min=0)
        queries = torch.arange(len(rows))
        start_ns, end_ns = known_ns[queries, before], known_ns[queries, after]
        span_ns = (end_ns - start_ns).clamp(min=1)  # a track of one box has nothing between
        return interpolate_rigid(
            self.world_from_box[rows, before],
            self.world_from_box[rows, after],
            (inside_ns - start_ns).double() / span_ns,
        )

    def all_at(self, timestamp_ns: int) -> Float[Tensor, "tracks 4 4"]:
        """Poses of all tracks at one time; not to be changed."""
        rows = torch.arange(len(self))
        return remembered(
            self._at, timestamp_ns, lambda: self.at(rows, torch.full_like(rows, timestamp_ns))
        )


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
        rows = rows[torch.argsort(timestamps_ns[rows], stable=True)]
        is_last = torch.ones(len(rows), dtype=torch.bool)  # of several boxes of one time
        is_last[:-1] = timestamps_ns[rows].diff() > 0
        rows = rows[is_last]
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
