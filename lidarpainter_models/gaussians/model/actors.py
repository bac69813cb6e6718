"""The actors: where they were recorded, and what was corrected about it.

An actor's correction is a small motion in its box frame, linear in time between knots at the
training times. Box frame: x along the length, y left, z up, origin at the centre. Tangents are
(rotation vector in radians, translation in metres), float64.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from lidarpainter_models.gaussians.model.pose_blending import RefinedTrack
from lidarpainter_models.geometry.transforms import rigid_from_tangent
from lidarpainter_models.scenes.driving_scene import ActorTrack

PRESENCE_MARGIN_NS = 60_000_000
"""An actor stays for half a 10 Hz frame (and a little) beyond its first and last box."""

ActorPoses = tuple[Float[Tensor, "actors 4 4"], Float[Tensor, " actors"]]
"""`world_from_actor` of every actor at a time, and 1 for each that is present then, else 0."""


@dataclass(frozen=True, eq=False)
class _Motions:
    """What follows from the corrections as they are."""

    tangent: Float[Tensor, "actors knots 6"]
    refined: tuple[RefinedTrack | None, ...]
    """Poses at the training times; None for an actor that is never present at one."""
    likely_at: dict[int, Float[Tensor, "actors 4 4"]] = field(default_factory=dict)
    """By time: all views of a time, and all shifts of a view, show the actors alike."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Actors:
    """Recorded tracks with small motions of their boxes; body i + 1 is the i-th track's."""

    recorded_tracks: tuple[ActorTrack, ...]
    knots_ns: Int[Tensor, " knots"]
    tangent: Float[Tensor, "actors knots 6"]
    """Changed in place by a fit."""
    _recorded_at: dict[int, ActorPoses] = field(default_factory=dict, init=False, repr=False)
    _made: list[_Motions] = field(default_factory=list, init=False, repr=False)
    """At most one."""

    @classmethod
    def uncorrected(cls, tracks: Sequence[ActorTrack], knots_ns: Int[Tensor, " knots"]) -> "Actors":
        """Nothing corrected yet; knots are sorted and taken once."""
        knots = torch.unique(knots_ns)
        return cls(
            recorded_tracks=tuple(tracks),
            knots_ns=knots,
            tangent=torch.zeros(len(tracks), knots.numel(), 6, dtype=torch.float64),
        )

    def neighbours(self, timestamp_ns: int) -> tuple[int, int, float]:
        """The knots before and after a time and the weight of the later one."""
        after = int(torch.searchsorted(self.knots_ns, timestamp_ns))
        last = self.knots_ns.numel() - 1
        if after == 0 or after > last:
            end = min(after, last)
            return end, end, 0.0
        start_ns, end_ns = int(self.knots_ns[after - 1]), int(self.knots_ns[after])
        return after - 1, after, (timestamp_ns - start_ns) / (end_ns - start_ns)

    def tangent_at(self, timestamp_ns: int) -> Float[Tensor, "actors 6"]:
        """Every actor's correction at a time; differentiable."""
        before, after, weight = self.neighbours(timestamp_ns)
        return (1 - weight) * self.tangent[:, before] + weight * self.tangent[:, after]

    def corrected_poses(self, timestamp_ns: int) -> ActorPoses:
        """Recorded poses at a time with the correction of that time; differentiable."""
        recorded, present = self._recorded_poses(timestamp_ns)
        return recorded @ rigid_from_tangent(self.tangent_at(timestamp_ns)), present

    def likely_poses(self, timestamp_ns: int) -> ActorPoses:
        """Most likely poses at any time.

        At training times these are the refined poses; in between see `pose_blending`.
        """
        recorded, present = self._recorded_poses(timestamp_ns)
        known = self._motions().likely_at
        if timestamp_ns not in known:
            poses = recorded.clone()
            for index in present.nonzero()[:, 0].tolist():
                poses[index] = self._likely_pose(index, timestamp_ns)
            known[timestamp_ns] = poses
        return known[timestamp_ns], present

    def refined_tracks(self) -> tuple[ActorTrack, ...]:
        """The tracks with the most likely poses at their own times."""
        return tuple(
            replace(
                track,
                world_from_box=torch.stack(
                    [self._likely_pose(index, int(time_ns)) for time_ns in track.timestamps_ns]
                ),
            )
            for index, track in enumerate(self.recorded_tracks)
        )

    def _recorded_poses(self, timestamp_ns: int) -> ActorPoses:
        if timestamp_ns not in self._recorded_at:
            self._recorded_at[timestamp_ns] = _poses_at(self.recorded_tracks, timestamp_ns)
        return self._recorded_at[timestamp_ns]

    def _likely_pose(self, index: int, timestamp_ns: int) -> Float[Tensor, "4 4"]:
        recorded = self.recorded_tracks[index].pose_at(timestamp_ns).double()
        refined = self._motions().refined[index]
        return recorded if refined is None else refined.pose_at(timestamp_ns * 1e-9, recorded)

    def _motions(self) -> _Motions:
        """Made again when the corrections changed."""
        tangent = self.tangent.detach()
        if not self._made or not torch.equal(self._made[0].tangent, tangent):
            kept = tangent.clone()
            tracks = zip(self.recorded_tracks, kept, strict=True)
            refined = tuple(_refined_track(track, self.knots_ns, own) for track, own in tracks)
            self._made[:] = [_Motions(kept, refined)]
        return self._made[0]


def _refined_track(
    track: ActorTrack, knots_ns: Int[Tensor, " knots"], tangent: Float[Tensor, "knots 6"]
) -> RefinedTrack | None:
    rows = [row for row, knot_ns in enumerate(knots_ns.tolist()) if _is_present(track, knot_ns)]
    if not rows:
        return None
    recorded = torch.stack([track.pose_at(int(knots_ns[row])).double() for row in rows])
    return RefinedTrack(
        times_s=knots_ns[rows].double() * 1e-9,
        recorded=recorded,
        refined=recorded @ rigid_from_tangent(tangent[rows]),
    )


def _poses_at(tracks: tuple[ActorTrack, ...], timestamp_ns: int) -> ActorPoses:
    """Recorded poses at a time and 1 where the actor is present."""
    if not tracks:
        return torch.zeros(0, 4, 4, dtype=torch.float64), torch.zeros(0, dtype=torch.float64)
    poses = torch.stack([track.pose_at(timestamp_ns).double() for track in tracks])
    present = [_is_present(track, timestamp_ns) for track in tracks]
    return poses, torch.tensor(present, dtype=torch.float64)


def _is_present(track: ActorTrack, timestamp_ns: int) -> bool:
    return track.is_present(timestamp_ns, PRESENCE_MARGIN_NS)
