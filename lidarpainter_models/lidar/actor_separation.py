"""Which points of a sweep lie in or beside moving actors, and where in their boxes.

A LiDAR takes a tenth of a second to turn, and a box holds at one moment of it: each point is
looked at in the box as it stood at the point's own time. Box frame: x along the length, y left,
z up, origin at the centre; metres.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from lidarpainter_models.geometry.transforms import interpolate_rigid
from lidarpainter_models.lidar.ground_heights import GroundHeights
from lidarpainter_models.scenes.tracks import ActorTrack

_TICK_NS = 1_000_000
"""Points of one millisecond share a pose: at 40 m/s it is 2 cm wrong."""
_LONGEST_EXTRAPOLATION_S = 0.1
"""One sweep: a point may be measured before the first or after the last box of its actor."""
_HALF_SWEEP_NS = 50_000_000
"""The speed of an actor is told from where it is so much earlier and later."""
_ROUNDING_M = 0.01
"""More than float32 loses at the ends of a log."""
ACTOR_MARGIN_M = 0.1
"""Points up to this far outside the box still belong to the actor: mirrors, tight boxes."""
STREET_MARGIN_M = 0.3  # points up to this far outside the box are kept out of the street
LAG_S = 0.02
"""Box times may be off by so much: lengthwise the street margin grows by it times the speed."""
ROAD_HEIGHT_M = 0.08  # what is lower than this above the ground is road, also below an actor
CLEARANCE_M = 0.15  # what is lower than this above the ground is no part of an actor
MOST_GROUND_OFFSET_M = 0.6
"""Ground further from the bottom of the box than this is not believed; the bottom is."""


@dataclass(frozen=True, kw_only=True, eq=False)
class NearActors:
    """Points in or beside boxes, each with the box it is nearest to."""

    rows: Int[Tensor, " near"]
    """Position among the points of the sweep."""
    track: Int[Tensor, " near"]
    """Position among the tracks."""
    xyz_box_m: Float[Tensor, "near 3"]
    """In the box frame, float32."""
    outside_m: Float[Tensor, " near"]
    """How far outside the box, along the axis where it is furthest; <= 0 is inside."""
    bottom_m: Float[Tensor, " near"]
    """World z of the bottom of the box."""

    def keep(self, kept: Tensor) -> "NearActors":
        """The points listed."""
        return NearActors(**{part.name: getattr(self, part.name)[kept] for part in fields(self)})


def near_actors(
    xyz_m: Float[Tensor, "points 3"],
    timestamp_ns: Int[Tensor, " points"],
    tracks: Sequence[ActorTrack],
) -> NearActors:
    """Find the points that moving actors keep out of the street."""
    candidates = _candidates(xyz_m, timestamp_ns, tracks)
    if not candidates:
        none, zero = torch.zeros(0, dtype=torch.int64), torch.zeros(0)
        return NearActors(
            rows=none, track=none, xyz_box_m=torch.zeros(0, 3), outside_m=zero, bottom_m=zero
        )
    near = _near(xyz_m, tracks, candidates)
    rows, outside_m = near.rows, near.outside_m
    # a point beside two boxes goes to the one it is deeper in: that row comes first
    order = torch.argsort(outside_m, stable=True)
    order = order[torch.argsort(rows[order], stable=True)]
    is_first = torch.ones_like(rows, dtype=torch.bool)
    is_first[1:] = rows[order][1:] != rows[order][:-1]
    return near.keep(order[is_first])


def height_above_ground(
    xyz_m: Float[Tensor, "near 3"], bottom_m: Float[Tensor, " near"], ground: GroundHeights
) -> Float[Tensor, " near"]:
    """Height of points near actors above the ground, or above the box where that is unknown."""
    ground_m = ground.at(xyz_m[:, :2])
    is_believed = (ground_m - bottom_m).abs() <= MOST_GROUND_OFFSET_M  # False for NaN
    return xyz_m[:, 2] - torch.where(is_believed, ground_m, bottom_m)


def poses_at(
    track: ActorTrack, timestamp_ns: Int[Tensor, " points"]
) -> Float[Tensor, "points 4 4"]:
    """`world_from_box` at many times (float64).

    Up to a sweep beyond the ends of the track its first or last motion goes on.
    """
    if len(track.timestamps_ns) == 1:
        return track.world_from_box.expand(len(timestamp_ns), 4, 4)
    return interpolate_rigid(*_ends(track, timestamp_ns))


def _ends(
    track: ActorTrack, timestamp_ns: Int[Tensor, " times"]
) -> tuple[Float[Tensor, "times 4 4"], Float[Tensor, "times 4 4"], Float[Tensor, " times"]]:
    """The boxes about each time, and which part of the way from one to the other it is."""
    if len(track.timestamps_ns) == 1:
        pose = track.world_from_box.expand(len(timestamp_ns), 4, 4)
        return pose, pose, torch.zeros(len(timestamp_ns), dtype=torch.float64)
    before, fraction = _between(track, timestamp_ns)
    return track.world_from_box[before], track.world_from_box[before + 1], fraction


def _centres_at(track: ActorTrack, timestamp_ns: Int[Tensor, " times"]) -> Float[Tensor, "times 3"]:
    """The centres of `poses_at`, without the cost of turning."""
    centres = track.world_from_box[:, :3, 3]
    if len(centres) == 1:
        return centres.expand(len(timestamp_ns), 3)
    before, fraction = _between(track, timestamp_ns)
    mix = fraction[:, None]
    return (1 - mix) * centres[before] + mix * centres[before + 1]


def _between(
    track: ActorTrack, timestamp_ns: Int[Tensor, " times"]
) -> tuple[Int[Tensor, " times"], Float[Tensor, " times"]]:
    """After which box each time comes, and which part of the way to the next one."""
    times_ns = track.timestamps_ns
    reach_ns = round(_LONGEST_EXTRAPOLATION_S * 1e9)
    wanted_ns = timestamp_ns.clamp(int(times_ns[0]) - reach_ns, int(times_ns[-1]) + reach_ns)
    before = (torch.searchsorted(times_ns, wanted_ns, right=True) - 1).clamp(0, len(times_ns) - 2)
    span_ns = (times_ns[before + 1] - times_ns[before]).double()
    return before, (wanted_ns - times_ns[before]).double() / span_ns


class _Candidates(NamedTuple):
    """The points about one actor, and between which of its boxes each was measured."""

    number: int
    """Of the track."""
    rows: Int[Tensor, " points"]
    own_time: Int[Tensor, " points"]
    """Position among the times."""
    earlier: Float[Tensor, "times 4 4"]
    later: Float[Tensor, "times 4 4"]
    fraction: Float[Tensor, " times"]
    margin_m: Float[Tensor, "3"]


def _candidates(
    xyz_m: Float[Tensor, "points 3"],
    timestamp_ns: Int[Tensor, " points"],
    tracks: Sequence[ActorTrack],
) -> list[_Candidates]:
    """What may be in or beside each actor that is there."""
    if not len(xyz_m):
        return []
    # in order of x: of a sweep, an actor has few
    across, rows_across = xyz_m[:, 0].sort()
    middle_ns = (int(timestamp_ns.min()) + int(timestamp_ns.max())) // 2
    margin_ns = round(_LONGEST_EXTRAPOLATION_S * 1e9)
    around_ns = middle_ns + torch.tensor([-_HALF_SWEEP_NS, 0, _HALF_SWEEP_NS])
    found = []
    for number, track in enumerate(tracks):
        if not track.is_present(middle_ns, margin_ns=margin_ns):
            continue
        earlier, centre, later = _centres_at(track, around_ns)
        speed_mps = float((later - earlier).norm()) * 1e9 / (2 * _HALF_SWEEP_NS)
        margin_m = torch.full((3,), STREET_MARGIN_M)
        margin_m[0] += LAG_S * speed_mps
        reach_m = float((track.size_m / 2 + margin_m).norm()) + _LONGEST_EXTRAPOLATION_S * speed_mps
        centre = centre.to(xyz_m)
        ends_m = centre[0] + (reach_m + _ROUNDING_M) * torch.tensor([-1.0, 1.0])
        first, last = torch.searchsorted(across, ends_m).tolist()
        rows = rows_across[first:last]
        rows = rows[((xyz_m[rows] - centre).abs() <= reach_m).all(dim=-1)].sort().values
        if len(rows):
            times_ns, own_time = torch.unique(timestamp_ns[rows] // _TICK_NS, return_inverse=True)
            ends = _ends(track, times_ns * _TICK_NS + _TICK_NS // 2)
            found.append(_Candidates(number, rows, own_time, *ends, margin_m))
    return found


def _near(
    xyz_m: Float[Tensor, "points 3"],
    tracks: Sequence[ActorTrack],
    candidates: Sequence[_Candidates],
) -> NearActors:
    """Those of the candidates that are in or beside their actor, of all actors at once."""
    counts = torch.tensor([len(one.rows) for one in candidates])
    times = torch.tensor([len(one.fraction) for one in candidates])
    whose = torch.arange(len(candidates)).repeat_interleave(counts)
    own_time = torch.cat([one.own_time for one in candidates]) + (times.cumsum(0) - times)[whose]
    rows = torch.cat([one.rows for one in candidates])
    world_from_box = interpolate_rigid(
        torch.cat([one.earlier for one in candidates]),
        torch.cat([one.later for one in candidates]),
        torch.cat([one.fraction for one in candidates]),
    )[own_time]
    away = xyz_m[rows].double() - world_from_box[:, :3, 3]
    xyz_box_m = torch.einsum("nij,ni->nj", world_from_box[:, :3, :3], away).float()
    half_m = torch.stack([tracks[one.number].size_m / 2 for one in candidates])
    beyond_m = xyz_box_m.abs() - half_m[whose]
    margin_m = torch.stack([one.margin_m for one in candidates])
    near = NearActors(
        rows=rows,
        track=torch.tensor([one.number for one in candidates])[whose],
        xyz_box_m=xyz_box_m,
        outside_m=beyond_m.amax(dim=-1),
        bottom_m=(world_from_box[:, 2, 3] - half_m[whose, 2]).float(),
    )
    return near.keep((beyond_m <= margin_m[whose]).all(dim=-1))
