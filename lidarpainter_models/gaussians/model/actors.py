"""The actors: where they were recorded, and what the fit refined about it.

An actor's correction is a small motion in its box frame, linear in time between knots at the
training times. Box frame: x along the length, y left, z up, origin at the centre. Tangents are
(rotation vector in radians, translation in metres), float64.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from lidarpainter_models.gaussians.model.actor_light import ActorLight
from lidarpainter_models.gaussians.model.bending import Bending, knots_around
from lidarpainter_models.gaussians.model.pose_blending import RefinedTracks
from lidarpainter_models.geometry.transforms import rigid_from_tangent
from lidarpainter_models.scenes.tracks import ActorTrack, TrackPoses, remembered

PRESENCE_MARGIN_NS = 60_000_000
"""An actor stays for half a 10 Hz frame (and a little) beyond its first and last box."""

ActorPoses = tuple[Float[Tensor, "actors 4 4"], Float[Tensor, " actors"]]
"""`world_from_actor` of every actor at a time, and 1 for each that is present then, else 0."""


@dataclass(frozen=True, eq=False)
class _Motions:
    """What follows from the corrections as they are."""

    tangent: Float[Tensor, "actors knots 6"]
    refined: RefinedTracks
    """Poses at the training times of the actors that are present at one, in their order."""
    refined_at: dict[int, Float[Tensor, "actors 4 4"]] = field(default_factory=dict)
    """Poses by time: all views of a time, and all shifts of a view, show the actors alike."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Actors:
    """Recorded tracks with small motions of their boxes; body i + 1 is the i-th track's."""

    recorded_tracks: tuple[ActorTrack, ...]
    knots_ns: Int[Tensor, " knots"]
    tangent: Float[Tensor, "actors knots 6"]
    """Changed in place by a fit."""
    light: ActorLight
    """How bright they are over time; its gains lie where the Gaussians do."""
    bending: Bending = field(default_factory=Bending.none)
    """How those bend that are not rigid; its offsets lie where the Gaussians do."""
    _recorded_at: dict[int, ActorPoses] = field(default_factory=dict, init=False, repr=False)
    _made: list[_Motions] = field(default_factory=list, init=False, repr=False)
    """What was made of the corrections last; at most one."""

    @classmethod
    def uncorrected(
        cls, tracks: Sequence[ActorTrack], knots_ns: Int[Tensor, " knots"], bent: Sequence[int] = ()
    ) -> "Actors":
        """Nothing corrected yet; knots are sorted and taken once, the `bent` tracks may bend."""
        knots = torch.unique(knots_ns)
        return cls(
            recorded_tracks=tuple(tracks),
            knots_ns=knots,
            tangent=torch.zeros(len(tracks), knots.numel(), 6, dtype=torch.float64),
            light=ActorLight.steady(len(tracks), knots),
            bending=Bending.none(
                [row + 1 for row in bent], [tracks[row].size_m for row in bent], knots
            ),
        )

    def to(self, device: torch.device) -> "Actors":
        """The same for Gaussians on another device; poses stay on the CPU."""
        return replace(self, bending=self.bending.to(device), light=self.light.to(device))

    def with_rigid(self, track: ActorTrack) -> "Actors":
        """The same and one more, who does not bend, as the last."""
        more = torch.zeros(1, *self.tangent.shape[1:], dtype=self.tangent.dtype)
        return replace(
            self,
            recorded_tracks=(*self.recorded_tracks, track),
            tangent=torch.cat([self.tangent, more]),
            light=self.light.with_steady(),
        )

    def without(self, body: int) -> "Actors":
        """The same without one; those after it move up."""
        kept = [row for row in range(len(self.recorded_tracks)) if row != body - 1]
        return replace(
            self,
            recorded_tracks=tuple(self.recorded_tracks[row] for row in kept),
            tangent=self.tangent[kept],
            light=self.light.kept(kept),
            bending=self.bending.without(body),
        )

    def knots_beside(self, timestamp_ns: int) -> set[int]:
        """The knots that a correction at a time is not made of and stands next to."""
        before, after, weight = knots_around(self.knots_ns, timestamp_ns)
        first = after if weight == 1 else before
        last = before if weight == 0 else after
        return {max(first - 1, 0), min(last + 1, self.knots_ns.numel() - 1)}

    def tangent_at(self, timestamp_ns: int) -> Float[Tensor, "actors 6"]:
        """Every actor's correction at a time; differentiable."""
        before, after, weight = knots_around(self.knots_ns, timestamp_ns)
        return (1 - weight) * self.tangent[:, before] + weight * self.tangent[:, after]

    def refined_poses_in_fit(self, timestamp_ns: int) -> ActorPoses:
        """Recorded poses with their corrections at a training time; differentiable in these."""
        recorded, present = self.recorded_poses(timestamp_ns)
        return recorded @ rigid_from_tangent(self.tangent_at(timestamp_ns)), present

    def refined_poses(self, timestamp_ns: int) -> ActorPoses:
        """Refined poses at any time, without gradient.

        At training times they are those of `refined_poses_in_fit`; in between see `pose_blending`.
        """
        recorded, present = self.recorded_poses(timestamp_ns)

        def refined() -> Float[Tensor, "actors 4 4"]:
            actors = present.nonzero()[:, 0]
            poses = recorded.clone()
            times_ns = torch.full_like(actors, timestamp_ns)
            poses[actors] = self._refined_at(actors, times_ns, recorded[actors])
            return poses

        return remembered(self._motions().refined_at, timestamp_ns, refined), present

    def refined_tracks(self) -> tuple[ActorTrack, ...]:
        """The tracks with refined poses at their own times."""
        tracks = self.recorded_tracks
        if not tracks:
            return ()
        counts = [len(track.timestamps_ns) for track in tracks]
        poses = self._refined_at(
            torch.arange(len(tracks)).repeat_interleave(torch.tensor(counts)),
            torch.cat([track.timestamps_ns for track in tracks]),
            torch.cat([track.world_from_box.double() for track in tracks]),
        ).split(counts)
        return tuple(
            replace(track, world_from_box=own) for track, own in zip(tracks, poses, strict=True)
        )

    @cached_property
    def _recorded(self) -> TrackPoses:
        return TrackPoses.of(self.recorded_tracks)

    def recorded_poses(self, timestamp_ns: int) -> ActorPoses:
        """Poses at a time as they were recorded."""

        def recorded() -> ActorPoses:
            poses = self._recorded.all_at(timestamp_ns)
            present = self._recorded.present(timestamp_ns, PRESENCE_MARGIN_NS)
            return poses, present.double()

        return remembered(self._recorded_at, timestamp_ns, recorded)

    @cached_property
    def _present_at_knots(self) -> Bool[Tensor, "actors knots"]:
        return self._recorded.present(self.knots_ns[:, None], PRESENCE_MARGIN_NS).T

    def _refined_at(
        self,
        actors: Int[Tensor, " queries"],
        times_ns: Int[Tensor, " queries"],
        recorded: Float[Tensor, "queries 4 4"],
    ) -> Float[Tensor, "queries 4 4"]:
        """Refined poses of actors at times; as recorded for one that no training time saw."""
        is_refined = self._present_at_knots.any(dim=1)
        chosen = is_refined[actors].nonzero()[:, 0]
        bodies = (is_refined.cumsum(0) - 1)[actors[chosen]]
        poses = recorded.clone()
        poses[chosen] = self._motions().refined.poses_at(
            bodies, times_ns[chosen].double() * 1e-9, recorded[chosen]
        )
        return poses

    def _motions(self) -> _Motions:
        """Made again when the corrections changed."""
        tangent = self.tangent.detach()
        if not self._made or not torch.equal(self._made[0].tangent, tangent):
            kept = tangent.clone()
            self._made[:] = [_Motions(kept, self._refined(kept))]
        return self._made[0]

    def _refined(self, tangent: Float[Tensor, "actors knots 6"]) -> RefinedTracks:
        actors, knots = self._present_at_knots.nonzero().unbind(1)
        recorded = self._recorded.at(actors, self.knots_ns[knots])
        counts = self._present_at_knots.sum(dim=1)
        parts = counts[counts > 0].tolist()
        return RefinedTracks.of(
            (self.knots_ns[knots].double() * 1e-9).split(parts),
            recorded.split(parts),
            (recorded @ rigid_from_tangent(tangent[actors, knots])).split(parts),
        )
