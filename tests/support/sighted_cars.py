"""One car whose shape and colours are known, as runs see it from one end each."""

import torch
from gaussian_world import map_points, round_gaussians

from lidarpainter_models.assets.completion import completed
from lidarpainter_models.assets.seen_surfaces import LEAST_WEIGHT, SeenSurface
from lidarpainter_models.assets.sighted_vehicles import SightedVehicle
from lidarpainter_models.assets.sightings import Look, Sighting
from lidarpainter_models.editing.actor_models import ActorModel
from lidarpainter_models.lidar.vehicle_shapes import fitted_shape

SIZE_M = torch.tensor([4.7, 1.98, 1.45])


def true_rgb(places):
    """Red, darker towards the rear, with a stripe of white over the bonnet."""
    shade = 0.35 + 0.08 * places[:, :1]
    rgb = shade * torch.tensor([1.0, 0.3, 0.3])
    rgb[places[:, 0] > 1.4] = torch.tensor([0.8, 0.8, 0.75])
    return rgb


def look(azimuth_deg):
    return Look(
        azimuth_deg=azimuth_deg,
        elevation_deg=5.0,
        distance_m=10.0,
        num_pixels=5000,
        hidden_share=0.1,
    )


def sighting(chosen, *, shift_m=(0.0, 0.0, 0.0), gain=(1.0, 1.0, 1.0), azimuth_deg=0.0, paint=None):
    """What one run keeps of the true car, and how it publishes it.

    `chosen` says which places (by true place and normal) its images show, and its LiDAR too; its
    box stands elsewhere by `shift_m`, and it sees all colours multiplied by `gain`.
    """
    shape = fitted_shape(torch.zeros(0, 3), torch.zeros(0), SIZE_M)
    places, normals = shape.surface(0.1)
    points = places[chosen(places, normals)] - torch.tensor(shift_m)
    model = ActorModel(
        gaussians=round_gaussians(torch.zeros(1, 3), torch.full((1, 3), 0.5), sigma_m=0.05),
        points=map_points(points, torch.full_like(points, 0.5)),
        size_m=SIZE_M,
        category="car",
    )
    surface = SeenSurface.of(model)
    there = surface.places + torch.tensor(shift_m)
    rows = chosen(there, surface.normals)
    rgb = (true_rgb if paint is None else paint)(there) * torch.tensor(gain)
    surface.weight[rows] = 4 * LEAST_WEIGHT
    surface.rgb_sum[rows] = 4 * LEAST_WEIGHT * rgb[rows]
    surface.square_sum[rows] = 4 * LEAST_WEIGHT * rgb[rows].square().mean(1)
    seen = Sighting(looks=[look(azimuth_deg)], pixels_per_m=30.0)
    return SightedVehicle.of(surface, seen), completed(model, surface)


def front(places, normals):
    return (normals[:, 0] > 0.5) | ((normals[:, 1] > 0.3) & (places[:, 0] > -1.2))


def rear(places, normals):
    return (normals[:, 0] < -0.5) | ((normals[:, 1] > 0.3) & (places[:, 0] < 0.9))
