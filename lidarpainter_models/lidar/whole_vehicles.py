"""Vehicles of the map made whole: points where a vehicle must be and no beam met it.

A camera beside the driven lane sees sides of vehicles that no image and no sweep showed, and would
look through what stands there. The shape that fits a vehicle's points says where its surface goes
on, and what images saw of it in which colours (`vehicle_colours`). Such points begin a fit and are
shown to the painter; they are no measurement: `measured` leaves them out. World: x forward, y left,
z up; box frame: x along the length, y left, z up, origin at the centre; metres.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.spatial import cKDTree
from torch import Tensor

from lidarpainter_models.geometry.transforms import invert_rigid
from lidarpainter_models.kernels.box_owners import NO_BOX, box_owners
from lidarpainter_models.kernels.side_by_side import side_by_side
from lidarpainter_models.lidar.actor_separation import (
    ACTOR_MARGIN_M,
    ROAD_HEIGHT_M,
    height_above_ground,
)
from lidarpainter_models.lidar.ground_heights import GroundHeights
from lidarpainter_models.lidar.lidar_images import BEAM_SPACING_RAD
from lidarpainter_models.lidar.lidar_map import NO_FRAME, LidarMap, MapPoints
from lidarpainter_models.lidar.vehicle_colours import VehiclePlaces
from lidarpainter_models.lidar.vehicle_shapes import (
    INSET_M,
    OUTSIDE,
    SPACING_M,
    fitted_shape,
    has_known_shape,
)
from lidarpainter_models.scenes.tracks import ActorTrack

MEASURED_M = 0.12
"""A place nearer to a point that an image saw needs no guess."""
COLOUR_M, COLOURS = 0.15, 3
"""How far from a place, and how many, are the coloured points that tell its colour."""
LEAST_COLOURED = 60
"""Of a vehicle with fewer coloured points the colours are unknown."""
LEAST_SEEN = 0.05
"""So is that of one whose surface was seen to a smaller share."""
LOWEST_NORMAL = -0.5
"""What faces down by more is the underside."""
DARKEST = 0.02
_GROUND_SAMPLE = 400_000


@dataclass(frozen=True, eq=False)
class _Vehicle:
    """A vehicle, and the points that were measured of it."""

    track: ActorTrack
    points: MapPoints
    """In the box frame."""
    world_from_box: Float[Tensor, "4 4"] | None = None
    """Of one that is parked and part of the street."""


def with_whole_vehicles(lidar_map: LidarMap, tracks: Sequence[ActorTrack]) -> LidarMap:
    """The map with coloured points on the sides of its vehicles that no image saw.

    Vehicles of which too little was seen stay as they are. New points come last, with `NO_FRAME`
    for their frame; what was measured stays as it was.
    """
    shaped = [track for track in tracks if has_known_shape(track)]
    vehicles = [*_moving(lidar_map, shaped), *_parked(lidar_map, shaped)]
    street, actors = [lidar_map.street], dict(lidar_map.actors)
    for vehicle, guessed in zip(vehicles, side_by_side(_guessed, vehicles), strict=True):
        if guessed is None:
            continue
        if vehicle.world_from_box is None:
            actors[vehicle.track.actor_id] = MapPoints.concatenate([vehicle.points, guessed])
        else:
            street.append(guessed.moved(vehicle.world_from_box))
    return LidarMap(street=MapPoints.concatenate(street), actors=actors)


def _moving(lidar_map: LidarMap, tracks: Sequence[ActorTrack]) -> Iterator[_Vehicle]:
    """Vehicles that have points of their own in the map."""
    for track in tracks:
        if track.is_moving and track.actor_id in lidar_map.actors:
            yield _Vehicle(track, lidar_map.actors[track.actor_id])


def _parked(lidar_map: LidarMap, tracks: Sequence[ActorTrack]) -> Iterator[_Vehicle]:
    """Vehicles whose points are those of the street in their boxes, over the ground."""
    parked, street = [track for track in tracks if not track.is_moving], lidar_map.street
    if not parked or not len(street):
        return
    poses = torch.stack([track.middle_pose for track in parked])
    owner = box_owners(
        street.xyz_m,
        invert_rigid(poses).float(),
        torch.stack([track.size_m for track in parked]),
        margin_m=ACTOR_MARGIN_M,
        floor_m=ROAD_HEIGHT_M,
    )
    held = (owner != NO_BOX).nonzero()[:, 0]
    owner = owner[held].long()
    bottom_m = torch.stack([track.size_m[2] / 2 for track in parked])
    bottom_m = (poses[:, 2, 3].float() - bottom_m)[owner]
    ground = GroundHeights(street.xyz_m[:: max(1, len(street) // _GROUND_SAMPLE)])
    is_above = height_above_ground(street.xyz_m[held], bottom_m, ground) >= ROAD_HEIGHT_M
    held, owner = held[is_above], owner[is_above]
    order = owner.argsort(stable=True)
    counts = torch.bincount(owner, minlength=len(parked)).tolist()
    for track, pose, rows in zip(parked, poses, held[order].split(counts), strict=True):
        yield _Vehicle(track, street.keep(rows).moved(invert_rigid(pose)), pose)


def _guessed(vehicle: _Vehicle) -> MapPoints | None:
    """Points where no image saw a vehicle, in its box frame; None where too little is known.

    None of them is its underside, which nobody looks at and which would pass for the ground.
    """
    track, points = vehicle.track, vehicle.points
    is_inside = (points.xyz_m.abs() <= OUTSIDE * track.size_m / 2).all(dim=1)
    body = points.keep(is_inside.nonzero()[:, 0])
    if int(body.has_colour.sum()) < LEAST_COLOURED:
        return None
    shape = fitted_shape(body.xyz_m, torch.ones(len(body)), track.size_m)
    places, normals = shape.surface(SPACING_M)
    rgb, is_seen = _colours_near(places, body)
    if float(is_seen.float().mean()) < LEAST_SEEN:
        return None
    known = VehiclePlaces(shape=shape, places=places, normals=normals, rgb=rgb, is_seen=is_seen)
    rgb_u8 = (known.coloured()[0].clamp(DARKEST, 1) * 255).round().to(torch.uint8)
    coloured = body.keep(body.has_colour.nonzero()[:, 0])
    is_open = torch.from_numpy(_distance_m(places, coloured.xyz_m) > MEASURED_M)
    is_open &= normals[:, 2] > LOWEST_NORMAL
    is_open &= places[:, 2] > ROAD_HEIGHT_M - track.size_m[2] / 2
    return _guessed_points((places - INSET_M * normals)[is_open], rgb_u8[is_open], body)


def _colours_near(
    places: Float[Tensor, "places 3"], body: MapPoints
) -> tuple[Float[Tensor, "places 3"], Bool[Tensor, " places"]]:
    """Mean colours of the coloured points about places, and which places have any."""
    coloured = body.keep(body.has_colour.nonzero()[:, 0])
    distance_m, nearest = cKDTree(coloured.xyz_m.numpy()).query(
        places.numpy(), COLOURS, distance_upper_bound=COLOUR_M
    )
    is_near = np.isfinite(distance_m)
    weight = np.where(is_near, 1 / np.maximum(distance_m, 0.02), 0)
    rgb = coloured.rgb_u8.numpy()[np.where(is_near, nearest, 0)] / 255
    total = weight.sum(1)
    mean = (rgb * weight[..., None]).sum(1) / np.maximum(total, 1e-6)[:, None]
    return torch.from_numpy(mean).float(), torch.from_numpy(total > 0)


def _distance_m(places: Float[Tensor, "places 3"], others: Float[Tensor, "points 3"]) -> np.ndarray:
    """How far the nearest of some points is."""
    found, _ = cKDTree(others.numpy()).query(places.numpy())
    return np.asarray(found)


def _guessed_points(xyz_m: Float[Tensor, "points 3"], rgb_u8: Tensor, body: MapPoints) -> MapPoints:
    """Points as new as those of the body are on average, as coarse as they are apart."""
    count = len(xyz_m)
    return MapPoints(
        xyz_m=xyz_m,
        rgb_u8=rgb_u8,
        has_colour=torch.ones(count, dtype=torch.bool),
        frame_index=torch.full((count,), NO_FRAME),
        timestamp_ns=body.timestamp_ns.median().repeat(count),
        range_m=torch.full((count,), SPACING_M / BEAM_SPACING_RAD),
    )
