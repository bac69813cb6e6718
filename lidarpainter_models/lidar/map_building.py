"""Every LiDAR point of a log in its place: the street in the world, actors in their boxes.

The street keeps what stands still, parked cars too; points of moving actors are carried to the box
frame of their actor by the pose at each point's own time, so that all sweeps of an actor fall onto
one another. When a point was measured stays with it: which points an image may use, and how old
they are then, is decided when one is rendered. Colours come from the given images alone.
"""

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from typing import Protocol, TypeVar, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from lidarpainter_models.errors import SceneError
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.lidar.actor_separation import (
    ACTOR_MARGIN_M,
    CLEARANCE_M,
    ROAD_HEIGHT_M,
    NearActors,
    height_above_ground,
    near_actors,
)
from lidarpainter_models.lidar.colouring import MapColouring
from lidarpainter_models.lidar.ground_heights import GroundHeights
from lidarpainter_models.lidar.lidar_map import LidarMap, MapPoints
from lidarpainter_models.scenes.driving_scene import DrivingScene
from lidarpainter_models.scenes.lone_returns import confirmed_returns
from lidarpainter_models.scenes.records import RecordedView, Sweep
from lidarpainter_models.scenes.splits import Keyed
from lidarpainter_models.scenes.tracks import ActorTrack


@runtime_checkable
class Placed(Keyed, Protocol):
    """A view of a camera somewhere, recorded or prepared for a fit."""

    @property
    def camera(self) -> Camera:
        """Where it stands."""

    @property
    def timestamp_ns(self) -> int:
        """When its image is of."""


View = TypeVar("View", bound=Placed)

_GROUND_SAMPLE = 400_000
"""Points that the ground is estimated from; more do not change it."""
MIN_RANGE_M = 1.0  # nearer returns come from the LiDAR's own housing
EGO_RANGE_M = 2.6  # returns nearer than this are the ego vehicle's own body
EGO_HALF_WIDTH_M = 1.2
"""... when also less than this to the left or right of the LiDAR; a car beside it is not."""
LEAST_WAY_M, MOST_PAUSE_NS = 0.05, 500_000_000
"""A sweep or an image taken nearer to the one before, and sooner after it, shows no new street."""
MAX_RANGE_M = 300.0  # further returns are left out: there a beam is a metre wide


def build_lidar_map(
    scene: DrivingScene, *, split_frames: Collection[int], colour_views: Sequence[RecordedView]
) -> LidarMap:
    """Gather the sweeps of some frames into one map, coloured by some images.

    `colour_views` are those of the training set, no others.

    Raises:
        SceneError: the frames hold no point in range.
    """
    points = gather_points(scene, split_frames)
    if len(points.street) == 0:
        raise SceneError(
            f"{scene.dataset}/{scene.sequence}: no LiDAR point within {MAX_RANGE_M:g} m in "
            f"frames {sorted(split_frames)}"
        )
    colouring = MapColouring(points, scene.tracks, colour_views)
    colouring.add_recorded(scene, colour_views)
    return colouring.coloured(colouring.gains())


def gather_points(scene: DrivingScene, split_frames: Collection[int]) -> LidarMap:
    """The sweeps of some frames in a map without colours yet; empty where they met nothing.

    Of a LiDAR that stands a sweep each half second is enough for the street, not for who moves.
    """
    tracks = [track for track in scene.tracks if track.is_moving]
    taken = [sweep for sweep in scene.sweeps if sweep.frame_index in set(split_frames)]
    sweeps = [_place_sweep(scene, sweep, tracks) for sweep in taken]
    are_new = _show_more(
        (sweep.lidar_name, sweep.timestamp_ns, sweep.world_from_lidar) for sweep in taken
    )
    street_parts = [placed.away for placed, is_new in zip(sweeps, are_new, strict=True) if is_new]
    ground = _ground(street_parts)
    actor_parts: dict[str, list[MapPoints]] = {}
    for placed, is_new in zip(sweeps, are_new, strict=True):
        road, of_actors = _sort_near_points(placed, tracks, ground)
        if is_new:
            street_parts.append(road)
        for actor_id, points in of_actors.items():
            actor_parts.setdefault(actor_id, []).append(points)
    street = MapPoints.concatenate(street_parts)
    actors = {actor_id: MapPoints.concatenate(parts) for actor_id, parts in actor_parts.items()}
    return LidarMap(street=street, actors=actors)


def _show_more(poses: Iterable[tuple[str, int, Float[Tensor, "4 4"]]]) -> list[bool]:
    """Which poses (sensor, time, pose) show more of the street than those before of their sensor.

    They come in order of time.
    """
    last: dict[str, tuple[int, Float[Tensor, 3]]] = {}
    are_new = []
    for sensor, time_ns, pose in poses:
        place = pose[:3, 3]
        is_new = sensor not in last
        if not is_new:
            before_ns, before = last[sensor]
            moved_m = float((place - before).norm())
            is_new = moved_m >= LEAST_WAY_M or time_ns - before_ns >= MOST_PAUSE_NS
        if is_new:
            last[sensor] = (time_ns, place)
        are_new.append(is_new)
    return are_new


def views_showing_more(views: Sequence[View]) -> list[View]:
    """Views that show more of the street than those before of their camera; in order of time."""
    are_new = _show_more(
        (view.key[1], view.timestamp_ns, view.camera.world_from_camera) for view in views
    )
    return [view for view, is_new in zip(views, are_new, strict=True) if is_new]


@dataclass(frozen=True, kw_only=True, eq=False)
class _PlacedSweep:
    """A sweep in the world and what of it lies in or beside actors."""

    away: MapPoints
    """Away from all actors."""
    beside: MapPoints
    """In or beside actors, as `near` lists them."""
    near: NearActors


def _place_sweep(scene: DrivingScene, sweep: Sweep, tracks: Sequence[ActorTrack]) -> _PlacedSweep:
    """Read a sweep, drop what is out of range or a drop, and find what lies near actors."""
    xyz_m, timestamp_ns = confirmed_returns(scene, sweep)
    away = xyz_m - sweep.world_from_lidar[:3, 3].to(xyz_m)
    range_m = away.norm(dim=-1)
    left = scene.world_from_ego[scene.frame_position(sweep.frame_index), :3, 1].to(away)
    is_ego = (range_m < EGO_RANGE_M) & ((away @ left).abs() < EGO_HALF_WIDTH_M)
    used = (range_m >= MIN_RANGE_M) & (range_m <= MAX_RANGE_M) & ~is_ego
    timestamp_ns = timestamp_ns[used]
    points = MapPoints.uncoloured(
        xyz_m=xyz_m[used],
        frame_index=torch.full_like(timestamp_ns, sweep.frame_index),
        timestamp_ns=timestamp_ns,
        range_m=range_m[used],
    )
    near = near_actors(points.xyz_m, timestamp_ns, tracks)
    is_away = torch.ones(len(points), dtype=torch.bool)
    is_away[near.rows] = False
    return _PlacedSweep(away=points.keep(is_away), beside=points.keep(near.rows), near=near)


def _ground(street_parts: Sequence[MapPoints]) -> GroundHeights:
    """The ground, from an even sample of the street."""
    total = sum(len(part) for part in street_parts)
    step = max(1, total // _GROUND_SAMPLE)
    sample = [part.xyz_m[::step] for part in street_parts]
    return GroundHeights(torch.cat([torch.zeros(0, 3), *sample]))  # of no sweeps, no points


def _sort_near_points(
    placed: _PlacedSweep, tracks: Sequence[ActorTrack], ground: GroundHeights
) -> tuple[MapPoints, dict[str, MapPoints]]:
    """Of the points near actors: the road under them, and the points of each actor."""
    near, beside = placed.near, placed.beside
    height_m = height_above_ground(beside.xyz_m, near.bottom_m, ground)
    road = beside.keep(height_m < ROAD_HEIGHT_M)
    is_actor = (height_m >= CLEARANCE_M) & (near.outside_m <= ACTOR_MARGIN_M)
    of_actors = {}
    for index in torch.unique(near.track[is_actor]).tolist():
        rows = (is_actor & (near.track == index)).nonzero()[:, 0]
        picked = beside.keep(rows)
        of_actors[tracks[index].actor_id] = MapPoints.uncoloured(
            xyz_m=near.xyz_box_m[rows],
            frame_index=picked.frame_index,
            timestamp_ns=picked.timestamp_ns,
            range_m=picked.range_m,
        )
    return road, of_actors
