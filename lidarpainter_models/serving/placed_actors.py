"""Actors of a fitted scene where a simulator puts them, in place of where they were recorded.

A pair of poses says where an actor is when the shutter opens and when it closes; in between, and
around it, it moves on evenly. Bodies bend and lamps are lit as they were recorded at that time.
"""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from functools import cached_property

import torch
from jaxtyping import Float
from torch import Tensor

from lidarpainter_models.gaussians.model.actors import ActorPoses, Actors
from lidarpainter_models.gaussians.model.gaussian_scene import GaussianScene
from lidarpainter_models.geometry.cameras import Camera, Shutter
from lidarpainter_models.geometry.transforms import quaternion_from_rotation, rigid_from_tangent
from lidarpainter_models.scenes.tracks import ActorTrack, TrackPoses
from lidarpainter_models.serving.messages import SensorRequest, TimedRequest, middle_of
from lidarpainter_models.serving.refusals import invalid

PARKED_M = 1.0
"""So far from where it was recorded an actor that is part of the street may be asked for."""
ROUNDING = 2e-6
"""By which poses may differ, beside as much of a length, and be the same: messages hold float32."""


@dataclass(frozen=True, kw_only=True, eq=False)
class PlacedActors(Actors):
    """Actors for the moment of one image."""

    middle_ns: int
    world_from_middle: Float[Tensor, "actors 4 4"]
    twist_per_s: Float[Tensor, "actors 6"]
    is_there: Float[Tensor, " actors"]
    """1 for each that is there, else 0."""

    def recorded_poses(self, timestamp_ns: int) -> ActorPoses:
        """Where actors are around the moment of the image."""
        moved = rigid_from_tangent(self.twist_per_s * ((timestamp_ns - self.middle_ns) * 1e-9))
        return self.world_from_middle @ moved, self.is_there

    def refined_poses(self, timestamp_ns: int) -> ActorPoses:
        """The same: where actors are put needs no correction."""
        return self.recorded_poses(timestamp_ns)


@dataclass(frozen=True, eq=False)
class ParkedActors:
    """Recorded actors that are part of the street."""

    tracks: Mapping[str, ActorTrack]
    """By actor id."""

    @cached_property
    def poses(self) -> TrackPoses:
        """Where they stand, in the order of the tracks."""
        return TrackPoses.of([*self.tracks.values()])

    @cached_property
    def row_of(self) -> dict[str, int]:
        """Rows of `poses` by actor id."""
        return {name: row for row, name in enumerate(self.tracks)}


@dataclass(frozen=True, kw_only=True, eq=False)
class Moment:
    """What a request shows: the scene with its actors in place, when, and from where."""

    scene: GaussianScene
    camera_name: str
    taken_ns: int
    timestamp_ns: int
    """Of the image as recorded; not `taken_ns` where a camera's clock was found wrong."""
    recorded: Camera | None
    """The recorded camera, where the request is of one; None for all else."""
    world_from_camera: Float[Tensor, "4 4"]
    shutter: Shutter | None


def same_pose(first: Tensor, second: Tensor) -> Tensor:
    """Whether poses are equal as far as messages tell."""
    return torch.isclose(first, second, rtol=ROUNDING, atol=ROUNDING).all(-1).all(-1)


def same_lens(first: Camera, second: Camera) -> bool:
    """Whether two pinholes are the same but for rounding."""
    names = ("fx_px", "fy_px", "cx_px", "cy_px")
    return all(abs(getattr(first, n) - getattr(second, n)) < 1e-6 * first.width_px for n in names)


def reads_alike(request: SensorRequest, camera: Camera) -> bool:
    """Whether a request has the shutter of a recorded camera."""
    shutter = camera.shutter
    if shutter is None or not shutter.is_rolling:
        return not request.readout_s
    readout_s = sum(map(abs, shutter.across_s))
    if any(
        abs(asked - own) > 2e-6
        for asked, own in zip(request.across_s, shutter.across_s, strict=True)
    ):
        return False
    half = torch.stack([-shutter.twist_per_s, shutter.twist_per_s]) * (readout_s / 2)
    ends = camera.world_from_camera.double() @ rigid_from_tangent(half)
    return bool(same_pose(request.world_from_sensor, ends).all())


def placed_actors(
    actors: Actors, parked: ParkedActors, request: TimedRequest, taken_ns: int
) -> Actors:
    """The actors of a scene as a request has them; as recorded, where it has them so.

    Args:
        actors: of the fitted scene.
        parked: recorded actors that are part of its street.
        request: who is there, and where.
        taken_ns: when the middle of the image is read.

    Raises:
        RequestError: INVALID_ARGUMENT: the scene has no such actor, or one that cannot be moved.
    """
    rows_of = {track.actor_id: row for row, track in enumerate(actors.recorded_tracks)}
    middle = middle_of(request.world_from_actors)
    _check_strangers(rows_of, parked, request, middle, taken_ns)
    chosen = [place for place, name in enumerate(request.actor_ids) if name in rows_of]
    rows = torch.tensor([rows_of[request.actor_ids[place]] for place in chosen], dtype=torch.int64)
    recorded, present = actors.refined_poses(taken_ns)
    world_from_middle, is_there = recorded.clone(), torch.zeros_like(present)
    world_from_middle[rows], is_there[rows] = middle[chosen], 1.0
    is_same = (is_there == present) & (same_pose(world_from_middle, recorded) | (present == 0))
    if bool(is_same.all()):
        return actors
    twists = torch.zeros(len(recorded), 6, dtype=torch.float64)
    twists[rows] = twists_of(request.world_from_actors[chosen], request.readout_s)
    own = {field.name: getattr(actors, field.name) for field in fields(actors) if field.init}
    return PlacedActors(
        **own,
        middle_ns=taken_ns,
        world_from_middle=world_from_middle,
        twist_per_s=twists,
        is_there=is_there,
    )


def twists_of(pairs: Float[Tensor, "bodies 2 4 4"], span_s: float) -> Float[Tensor, "bodies 6"]:
    """Turn (rad/s) and velocity (m/s) in their own frames of what moves from one pose to another.

    The frame is that of the middle; nothing moves where there is no time for it.
    """
    if span_s <= 0 or not len(pairs):
        return torch.zeros(len(pairs), 6, dtype=torch.float64)
    start, end = pairs.unbind(1)
    wxyz = quaternion_from_rotation(start[:, :3, :3].mT @ end[:, :3, :3])
    sine = wxyz[:, 1:].norm(dim=1)
    turned = wxyz[:, 1:] * (2 * torch.atan2(sine, wxyz[:, 0]) / sine.clamp(min=1e-12))[:, None]
    shift = (end - start)[:, :3, 3:]
    moved = (middle_of(pairs)[:, :3, :3].mT @ shift)[..., 0]
    return torch.cat([turned, moved], dim=1) / span_s


def _check_strangers(
    rows_of: dict[str, int],
    parked: ParkedActors,
    request: TimedRequest,
    middle: Float[Tensor, "actors 4 4"],
    taken_ns: int,
) -> None:
    """Refuse who is not in the scene, and who is part of its street and is moved."""
    known, names = parked.tracks, request.actor_ids
    strange = [name for name in names if name not in rows_of and name not in known]
    if strange:
        more = f" and {len(strange) - 1} more" if len(strange) > 1 else ""
        raise invalid(
            f"dynamic object {strange[0]!r}{more}: the scene has no such actor; "
            "get_dynamic_objects lists those it has"
        )
    places = [place for place, name in enumerate(names) if name in known]
    rows = torch.tensor([parked.row_of[names[place]] for place in places], dtype=torch.int64)
    standing = parked.poses.at(rows, torch.full_like(rows, taken_ns))
    away_m = (middle[places] - standing)[:, :3, 3].norm(dim=1)
    for place, moved_m in zip(places, away_m.tolist(), strict=True):
        if moved_m > PARKED_M:
            raise invalid(
                f"dynamic object {names[place]!r} is parked and part of the street: it cannot be "
                f"moved by {moved_m:.1f} m, expected at most {PARKED_M:g} m"
            )
