"""What recorded images show of the surface of a vehicle: where it was seen, and in which colours.

Box frame: x along the length, y left, z up, origin at the centre; camera: z ahead; metres.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from lidarpainter_models.editing.actor_models import OPAQUE, ActorModel
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.geometry.transforms import invert_rigid, transform_points
from lidarpainter_models.lidar.vehicle_colours import VehiclePlaces
from lidarpainter_models.lidar.vehicle_shapes import (
    OUTSIDE,
    SPACING_M,
    MeasuredPoints,
    VehicleShape,
    fitted_shape,
)

LEAST_FACING = 0.25
"""Cosine between the normal and the way to the camera: flatter looks smear."""
HIDDEN_M = 0.25
"""A surface so far before a place hides it."""
LEAST_WEIGHT = 9.0
"""Of a place that counts as seen: one look head-on at 3 pixels a metre."""
GAUSSIAN_WEIGHT = 0.3
"""What an opaque Gaussian says of the surface, against a point of LiDAR."""
WIDEST_M = 0.3
"""A Gaussian that is wider says nothing of where the surface is."""


@dataclass(kw_only=True, eq=False)
class SeenSurface:
    """Places on the surface of one vehicle, and what was seen of each."""

    model: ActorModel
    """Whose surface it is, as it was fitted."""
    shape: VehicleShape
    places: Float[Tensor, "places 3"]
    normals: Float[Tensor, "places 3"]
    weight: Float[Tensor, " places"]
    """Pixels per metre times the cosine of the look, squared, summed over looks; 0: never seen."""
    rgb_sum: Float[Tensor, "places 3"]
    square_sum: Float[Tensor, " places"]
    """Weighted squares of the colours, the mean of the channels: they tell how far looks agree."""

    @classmethod
    def of(cls, model: ActorModel) -> "SeenSurface":
        """The surface that fits the LiDAR points and opaque Gaussians of a model."""
        told = measured_points(model)
        return cls.unseen(model, fitted_shape(told.points_box, told.weight, model.size_m))

    @classmethod
    def unseen(cls, model: ActorModel, shape: VehicleShape) -> "SeenSurface":
        """The surface of a shape, before anything is seen of it."""
        places, normals = shape.surface(SPACING_M)
        return cls(
            model=model,
            shape=shape,
            places=places,
            normals=normals,
            weight=torch.zeros(len(places)),
            rgb_sum=torch.zeros(len(places), 3),
            square_sum=torch.zeros(len(places)),
        )

    def add_look(
        self,
        camera: Camera,
        world_from_box: Float[Tensor, "4 4"],
        *,
        rgb: Float[Tensor, "height width 3"],
        depth_m: Float[Tensor, "height width"],
        shows_surface: Bool[Tensor, "height width"],
    ) -> None:
        """Take the colours of one image, in those of the scene.

        Args:
            camera: of the image.
            world_from_box: pose of the box then.
            rgb: the image.
            depth_m: of what the scene shows there, 0 where that is the sky.
            shows_surface: where the image shows neither sky nor the recording car.
        """
        pose = world_from_box.double()
        eye_box = transform_points(invert_rigid(pose), camera.centre_world.double()[None])[0]
        to_eye = eye_box.float() - self.places
        distance_m = to_eye.norm(dim=1)
        facing = (to_eye * self.normals).sum(1) / distance_m
        pixels_uv, z_m = camera.project(transform_points(pose, self.places.double()))
        column, row = pixels_uv.floor().long().unbind(1)
        inside = (column >= 0) & (row >= 0) & (column < camera.width_px) & (row < camera.height_px)
        kept = (inside & (facing > LEAST_FACING) & (z_m > 0.5)).nonzero()[:, 0]
        row, column = row[kept], column[kept]
        before_m = depth_m[row, column]
        is_open = (before_m == 0) | (before_m > z_m[kept].float() - HIDDEN_M)
        is_open &= shows_surface[row, column]
        kept, row, column = kept[is_open], row[is_open], column[is_open]
        weight = (facing[kept] * camera.fx_px / distance_m[kept]).square()
        self.weight.index_add_(0, kept, weight)
        seen_rgb = rgb[row, column]
        self.rgb_sum.index_add_(0, kept, weight[:, None] * seen_rgb)
        self.square_sum.index_add_(0, kept, weight * seen_rgb.square().mean(1))

    @property
    def is_seen(self) -> Bool[Tensor, " places"]:
        """Places that an image showed well enough."""
        return self.weight >= LEAST_WEIGHT

    @property
    def seen_share(self) -> float:
        """Share of the places that were seen."""
        return float(self.is_seen.float().mean()) if len(self.places) else 0.0

    @property
    def rgb(self) -> Float[Tensor, "places 3"]:
        """Mean colours; of places that nobody saw they mean nothing."""
        return self.rgb_sum / self.weight.clamp(min=1e-6)[:, None]

    @property
    def known(self) -> VehiclePlaces:
        """The places with the colours that were seen."""
        return VehiclePlaces(
            shape=self.shape,
            places=self.places,
            normals=self.normals,
            rgb=self.rgb,
            is_seen=self.is_seen,
        )

    @property
    def disagreement(self) -> Float[Tensor, " places"]:
        """Variance of the colours that looks show of a place, the mean of the channels."""
        mean_square = self.square_sum / self.weight.clamp(min=1e-6)
        return (mean_square - self.rgb.square().mean(1)).clamp(min=0)


def measured_points(model: ActorModel) -> MeasuredPoints:
    """The LiDAR points and opaque Gaussians of a model inside its box."""
    own = model.gaussians
    is_told = (own.opacity > OPAQUE) & (own.scale_m.amax(1) < WIDEST_M)
    points = torch.cat([model.points.xyz_m, own.means.detach()[is_told]])
    weight = torch.ones(len(points))
    weight[len(model.points) :] = GAUSSIAN_WEIGHT
    inside = (points.abs() <= OUTSIDE * model.size_m / 2).all(dim=1)
    return MeasuredPoints(points[inside], weight[inside])
