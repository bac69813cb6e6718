"""What is in the way of a path: LiDAR points of the street, and boxes of actors.

A body is a box along its path: a camera with room around it, or a car, whose tyres touch the road.
World: z up; metres.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree
from torch import Tensor

from lidarpainter_models.geometry.transforms import invert_rigid
from lidarpainter_models.lidar.lidar_map import MapPoints
from lidarpainter_models.scenes.tracks import ActorTrack, TrackPoses

MOST_STRAY_POINTS_PER_M3 = 10
"""So many points in the room of a body still count as noise: a wall gives thousands."""
GROUND_CLEARANCE_M = 0.3
"""Lower points of a car's box are the road, kerbs, leaves."""
SKIN_M = 0.1
"""A car's box is so much larger than the car to each side, at most."""


@dataclass(frozen=True, eq=False, kw_only=True)
class MovingBody:
    """A box on its way."""

    world_from_box: Float[Tensor, "moments 4 4"]
    timestamps_ns: Int[Tensor, " moments"]
    size_m: Float[Tensor, "3"]

    @classmethod
    def camera(
        cls, world_from_camera: Float[Tensor, "moments 4 4"], timestamps_ns: Int[Tensor, " moments"]
    ) -> "MovingBody":
        """A camera and half a metre around it."""
        return cls(
            world_from_box=world_from_camera, timestamps_ns=timestamps_ns, size_m=torch.ones(3)
        )

    @classmethod
    def car(cls, track: ActorTrack) -> "MovingBody":
        """An actor on its track, without its skin and what is low enough to be road."""
        low_m = GROUND_CLEARANCE_M
        room_m = (track.size_m - torch.tensor([2 * SKIN_M, 2 * SKIN_M, low_m])).clamp(min=0.1)
        raised = track.world_from_box.double().clone()
        raised[:, :3, 3] += low_m / 2 * raised[:, :3, 2]
        return cls(world_from_box=raised, timestamps_ns=track.timestamps_ns, size_m=room_m)


@dataclass(frozen=True, kw_only=True)
class Collision:
    """Something in the way, and when."""

    obstacle: str
    """`points`, or the id of an actor."""
    from_s: float
    """Since the given start."""
    to_s: float
    num_points: int
    """The most at one moment; 0 for an actor."""

    @property
    def is_wall(self) -> bool:
        """Whether it stands there for good."""
        return self.num_points > 0

    def __str__(self) -> str:
        """For one line."""
        what = f"{self.num_points} LiDAR points" if self.is_wall else f"actor {self.obstacle}"
        return f"{what} from {self.from_s:.1f} to {self.to_s:.1f} s"


def find_collisions(
    body: MovingBody, street: MapPoints, tracks: Sequence[ActorTrack], *, start_ns: int
) -> list[Collision]:
    """What a body runs into: the street first, then actors in their order."""
    counts = points_inside(body, street.xyz_m)
    most = MOST_STRAY_POINTS_PER_M3 * max(1.0, float(body.size_m.prod()))
    hits = {"points": counts > most}
    hits |= {track.actor_id: row for track, row in zip(tracks, _touched(body, tracks), strict=True)}
    seconds = (body.timestamps_ns - start_ns).double() * 1e-9
    return [
        Collision(
            obstacle=obstacle,
            from_s=float(seconds[hit].min()),
            to_s=float(seconds[hit].max()),
            num_points=int(counts.max()) if obstacle == "points" else 0,
        )
        for obstacle, hit in hits.items()
        if bool(hit.any())
    ]


def points_inside(
    body: MovingBody, points_world: Float[Tensor, "points 3"]
) -> Int[Tensor, " moments"]:
    """How many points are in a body at each moment."""
    centres = body.world_from_box[:, :3, 3]
    reach_m = float(body.size_m.norm()) / 2
    low, high = centres.amin(0) - reach_m, centres.amax(0) + reach_m
    near = ((points_world >= low) & (points_world <= high)).all(dim=1).nonzero()[:, 0]
    counts = torch.zeros(len(centres), dtype=torch.int64)
    if not len(near):
        return counts
    close = points_world[near].double()
    found = cKDTree(close.numpy()).query_ball_point(centres.numpy(), reach_m)
    moments = torch.arange(len(centres)).repeat_interleave(torch.tensor([*map(len, found)]))
    rows = torch.from_numpy(np.concatenate([np.asarray(some, np.int64) for some in found]))
    box_from_world = invert_rigid(body.world_from_box)[moments]
    inside = (box_from_world[:, :3, :3] @ close[rows, :, None])[..., 0] + box_from_world[:, :3, 3]
    is_inside = (inside.abs() <= body.size_m.double() / 2).all(dim=1)
    return counts.index_add(0, moments[is_inside], torch.ones(int(is_inside.sum())).long())


def clearances_m(body: MovingBody, tracks: Sequence[ActorTrack]) -> Float[Tensor, "tracks moments"]:
    """How far each actor's box is from the body, seen from above.

    0 where they overlap, infinite where the actor is not there.
    """
    own, theirs, present = _seen_from_above(body, tracks)
    between = torch.minimum(_to_edges(own, theirs), _to_edges(theirs, own))
    between[~_apart(own, theirs)] = 0.0
    between[~present] = torch.inf
    return between


def _touched(body: MovingBody, tracks: Sequence[ActorTrack]) -> Bool[Tensor, "tracks moments"]:
    """Whether each actor's box and the body overlap, by separating axes of their outlines."""
    own, theirs, present = _seen_from_above(body, tracks)
    heights_m = torch.tensor([float(track.size_m[2]) for track in tracks], dtype=torch.float64)
    half_m = (body.size_m[2] + heights_m[:, None]) / 2
    above = (_poses(body, tracks)[..., 2, 3] - body.world_from_box[:, 2, 3]).abs() > half_m
    return present & ~_apart(own, theirs) & ~above


def _seen_from_above(
    body: MovingBody, tracks: Sequence[ActorTrack]
) -> tuple[
    Float[Tensor, "tracks moments 4 2"],
    Float[Tensor, "tracks moments 4 2"],
    Bool[Tensor, "tracks moments"],
]:
    """Corners of the body and of each actor at every moment, and whether the actor is there."""
    present = TrackPoses.of(tracks).present(body.timestamps_ns[:, None]).T
    sizes_m = torch.stack([torch.zeros(3), *(track.size_m for track in tracks)])[1:].double()
    own = _outline(body.world_from_box.double(), body.size_m.double())
    return (
        own.expand(len(tracks), -1, -1, -1),
        _outline(_poses(body, tracks), sizes_m[:, None]),
        present,
    )


def _poses(body: MovingBody, tracks: Sequence[ActorTrack]) -> Float[Tensor, "tracks moments 4 4"]:
    """Where each actor is at the moments of the body."""
    times_ns = body.timestamps_ns
    rows = torch.arange(len(tracks)).repeat_interleave(len(times_ns))
    poses = TrackPoses.of(tracks).at(rows, times_ns.repeat(len(tracks)))
    return poses.reshape(len(tracks), len(times_ns), 4, 4)


def _apart(
    own: Float[Tensor, "tracks moments 4 2"], theirs: Float[Tensor, "tracks moments 4 2"]
) -> Bool[Tensor, "tracks moments"]:
    """Whether a line can be laid between two outlines."""
    axes = torch.cat([_sides(own), _sides(theirs)], dim=2)
    ours_m = torch.einsum("tmcx,tmax->tmac", own, axes)
    theirs_m = torch.einsum("tmcx,tmax->tmac", theirs, axes)
    apart = (ours_m.amax(-1) < theirs_m.amin(-1)) | (theirs_m.amax(-1) < ours_m.amin(-1))
    return apart.any(dim=-1)


def _to_edges(
    corners: Float[Tensor, "tracks moments 4 2"], outline: Float[Tensor, "tracks moments 4 2"]
) -> Float[Tensor, "tracks moments"]:
    """The least distance from the corners of one outline to the edges of another."""
    start, edge = outline[..., None, :, :], (outline.roll(-1, 2) - outline)[..., None, :, :]
    away = corners[..., :, None, :] - start
    share = ((away * edge).sum(-1) / edge.square().sum(-1).clamp(min=1e-12)).clamp(0, 1)
    return (away - share[..., None] * edge).norm(dim=-1).flatten(2).amin(-1)


def _outline(
    world_from_box: Float[Tensor, "*batch 4 4"], size_m: Float[Tensor, "*sizes 3"]
) -> Float[Tensor, "*batch 4 2"]:
    """Corners of boxes seen from above, in their order around them."""
    signs = torch.tensor([[1.0, 1], [1, -1], [-1, -1], [-1, 1]], dtype=torch.float64) / 2
    corners = signs * size_m[..., None, :2]
    turned = torch.einsum("...ij,...cj->...ci", world_from_box[..., :2, :2], corners)
    return turned + world_from_box[..., None, :2, 3]


def _sides(corners: Float[Tensor, "*batch 4 2"]) -> Float[Tensor, "*batch 2 2"]:
    """Directions of two sides that meet."""
    return corners[..., 1:3, :] - corners[..., 0:2, :]
