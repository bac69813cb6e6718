"""Fuse sightings of one vehicle: one shape to all of its points, one surface of all that was seen.

Box frame: x along the length, y left, z up, origin at the centre; metres. Boxes of one vehicle
differ by centimetres from run to run; the fused one stands in the first sighting's. Colours are in
neutral exposure, which is told by the road of a run; roads differ, so each sighting has a gain of
its own.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from scipy.spatial import cKDTree
from torch import Tensor

from lidarpainter_models.assets.completion import WholeActor, completed
from lidarpainter_models.assets.seen_surfaces import LEAST_WEIGHT, SeenSurface
from lidarpainter_models.assets.sighted_vehicles import SightedVehicle
from lidarpainter_models.assets.sightings import Sighting
from lidarpainter_models.editing.actor_models import DARKEST, ActorModel
from lidarpainter_models.lidar.lidar_map import MapPoints
from lidarpainter_models.lidar.vehicle_shapes import SPACING_M, VehicleShape, fitted_shapes

REACH_M = 1.5 * SPACING_M
"""A place takes the colour that a sighting gives the nearest one, up to so far away."""
COMPARED_M = 0.15
"""Likewise where sightings are compared: paint is of one colour a little farther."""
ALIKE = 0.7
"""Least cosine between the normals of two such places."""
LEAST_COMMON = 40
"""Of fewer common places colours tell nothing of whose they are."""
MOST_APART = 0.2
"""Colours of common places that differ by more, as a median, are of two vehicles."""


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """How much brighter one sighting of a vehicle is than another, channel by channel."""

    log_ratio: tuple[float, float, float]
    """Natural logarithm; the median over the places that both show."""
    num_places: int


@dataclass(frozen=True, kw_only=True, eq=False)
class FusedVehicle:
    """A vehicle made of several sightings."""

    whole: WholeActor
    sighting: Sighting
    """What all of them show together."""
    taken: tuple[int, ...]
    """Which of the sightings are of this vehicle; of two at least."""


@dataclass(frozen=True, kw_only=True, eq=False)
class _Told:
    """What one sighting says of the places of a surface."""

    rgb: Float[Tensor, "places 3"]
    weight: Float[Tensor, " places"]
    """0 where it says nothing."""
    variance: Float[Tensor, " places"]

    @property
    def is_seen(self) -> Bool[Tensor, " places"]:
        return self.weight >= LEAST_WEIGHT


def compared(seen: Sequence[SightedVehicle], first: ActorModel) -> list[Comparison]:
    """The first of several sightings against each, itself too, where both show the same places.

    `first` is how the first was published.
    """
    shapes, surface = _shaped(seen, first)
    told = _told_by_all(seen, shapes, surface, COMPARED_M)
    found = []
    for one in told:
        both = told[0].is_seen & one.is_seen
        ratio = told[0].rgb[both].clamp(min=DARKEST) / one.rgb[both].clamp(min=DARKEST)
        middle = ratio.log().median(dim=0).values if len(ratio) else torch.zeros(3)
        red, green, blue = middle.tolist()
        found.append(Comparison(log_ratio=(red, green, blue), num_places=int(both.sum())))
    return found


def fused_vehicle(
    seen: Sequence[SightedVehicle],
    models: Sequence[ActorModel],
    gains: Float[Tensor, "sightings 3"],
) -> FusedVehicle | None:
    """The vehicle that several sightings show, in the box of the first; the best comes first.

    A sighting whose colours differ from those of the first where both show the same places is of
    somebody else and is left out. None if fewer than two are left.

    Args:
        seen: what was kept of each.
        models: each as it was published, in neutral exposure.
        gains: what brings the colours of each into one light.
    """
    taken = tuple(range(len(seen)))
    while len(taken) > 1:
        own = [seen[one] for one in taken]
        shapes, surface = _shaped(own, models[taken[0]])
        told = [
            replace(one, rgb=one.rgb * gain)
            for one, gain in zip(
                _told_by_all(own, shapes, surface, REACH_M), gains[list(taken)], strict=True
            )
        ]
        is_same = [_apart(told[0], one) <= MOST_APART for one in told]
        if all(is_same):
            _add_colours(surface, told)
            points = _points([models[one] for one in taken], shapes, gains[list(taken)])
            model = replace(models[taken[0]], points=points)
            return FusedVehicle(
                whole=completed(model, surface),
                sighting=Sighting.of_all([one.sighting for one in own]),
                taken=taken,
            )
        taken = tuple(one for one, same in zip(taken, is_same, strict=True) if same)
    return None


def _shaped(
    seen: Sequence[SightedVehicle], first: ActorModel
) -> tuple[list[VehicleShape], SeenSurface]:
    """The shape of a vehicle in the box of each sighting, and its surface in the first one's."""
    shapes = fitted_shapes([one.measured for one in seen], first.size_m)
    return shapes, SeenSurface.unseen(first, shapes[0])


def _told_by_all(
    seen: Sequence[SightedVehicle],
    shapes: Sequence[VehicleShape],
    surface: SeenSurface,
    reach_m: float,
) -> list[_Told]:
    pairs = zip(seen, shapes, strict=True)
    return [_told(one, shape, surface, reach_m) for one, shape in pairs]


def _apart(one: _Told, other: _Told) -> float:
    """How much colours differ where both show the same places: the median; 0 of too few."""
    both = one.is_seen & other.is_seen
    if int(both.sum()) < LEAST_COMMON:
        return 0.0
    return float((one.rgb[both] - other.rgb[both]).abs().mean(1).median())


def _told(seen: SightedVehicle, shape: VehicleShape, surface: SeenSurface, reach_m: float) -> _Told:
    """What a sighting, in whose box the vehicle has a shape, says of a surface."""
    count = len(surface.places)
    if not len(seen.places):
        nothing = torch.zeros(count)
        return _Told(rgb=torch.zeros(count, 3), weight=nothing, variance=nothing)
    places = shape.carried_to(surface.shape, seen.places)
    normals = seen.normals @ shape.rotation_to(surface.shape).T
    distance_m, row = cKDTree(places.numpy()).query(surface.places.numpy())
    nearest = torch.from_numpy(row)
    is_alike = (normals[nearest] * surface.normals).sum(1) >= ALIKE
    is_near = torch.from_numpy(distance_m) <= reach_m
    weight = torch.where(is_alike & is_near, seen.weight[nearest], 0.0)
    return _Told(rgb=seen.rgb[nearest], weight=weight, variance=seen.variance[nearest])


def _add_colours(surface: SeenSurface, told: Sequence[_Told]) -> None:
    """Give the places of a surface the mean of what sightings say of them."""
    for one in told:
        surface.weight += one.weight
        surface.rgb_sum += one.weight[:, None] * one.rgb
        surface.square_sum += one.weight * (one.rgb.square().mean(1) + one.variance)


def _points(
    models: Sequence[ActorModel],
    shapes: Sequence[VehicleShape],
    gains: Float[Tensor, "sightings 3"],
) -> MapPoints:
    """The LiDAR points of all, in the box and the light of the fused one."""
    found = []
    for model, shape, gain in zip(models, shapes, gains, strict=True):
        points = model.points
        rgb_u8 = (points.rgb_u8 * gain).round().clamp(0, 255).to(torch.uint8)
        xyz_m = shape.carried_to(shapes[0], points.xyz_m)
        found.append(replace(points, xyz_m=xyz_m, rgb_u8=rgb_u8))
    return MapPoints.concatenate(found)
