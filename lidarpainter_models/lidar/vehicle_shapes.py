"""Shapes of vehicles: signed distances as a mean and some axes, fitted to what was measured.

Box frame: x along the length, y left, z up, origin at the centre; metres. A shape has a frame of
its own, in which its plane of symmetry is y = 0: the vehicle's own, which need not be the middle of
its box. The model is that of Leventon, Grimson and Faugeras (2000): principal components of
signed distances; a latent number of 1 is one standard deviation.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from lidarpainter_models.scenes.categories import category_of
from lidarpainter_models.scenes.tracks import ActorTrack
from lidarpainter_models.storage.tensor_files import read_tensors

SHAPED = ("car", "van", "pickup", "vehicle")
"""Categories whose shapes are known."""
SHAPED_M = ((3.0, 6.2), (1.2, 2.8), (1.2, 2.8))
"""Least and most length, width and height of boxes whose shapes are known: what a data set calls a
vehicle may be a bus."""
SPACING_M = 0.06
"""Between places on a surface: as fine as 17 pixels a metre show."""
INSET_M = 0.04
"""What stands for a surface lies so far inside it: discs reach out around bends, and a guess would
hide what was seen beside it."""
OUTSIDE = 1.02
"""Of the half size of a box: who is farther out is no part of the body."""
BUNDLED = Path(__file__).parent / "bundled" / "vehicle_shapes.safetensors"
GRID = (48, 12, 20)
"""Nodes along x, |y| and z."""
REACH = 1.15
"""Where the grid ends, in half sizes of the box."""
TRUNCATION_M = 0.3
MATERIALS = ("paint", "glass", "dark", "white", "red", "rim")
"""What the surface is of: dark are tyres and grilles, white and red are lamps."""
SHARE_STEP = 0.01
"""Of what a share of a material is stored in."""
OUTLIER_M = 0.12
"""Where a point is half an outlier, in the loss of Geman and McClure (1985)."""
WHEELS_AT = (-0.6, 0.62)
"""Where axles are, in half lengths of the box."""
WHEEL_RADIUS = 0.07
"""In lengths of the box; in vehicles, wheels are too thin for the grid, hence apart."""
WHEEL_BESIDE = 0.91
"""Where their outer faces are, in half widths of the box, which holds the mirrors too."""
TREAD_M = 0.2
STEPS = 70
MOST_POINTS = 1500
LEAST_POINTS = 30
"""Of fewer points no shape follows."""
EVIDENCE = 300.0
"""Points are worth so many independent ones together: neighbours say the same."""
_SHIFT_M, _YAW_RAD, _STRETCH = 0.06, 0.02, 0.03
"""Deviations of the shape's frame from the box."""


def has_known_shape(track: ActorTrack) -> bool:
    """Whether the shape of an actor is one that is known."""
    sides = zip(track.size_m.tolist(), SHAPED_M, strict=True)
    has_size = all(least <= side <= most for side, (least, most) in sides)
    return category_of(track.category) in SHAPED and has_size


@dataclass(frozen=True, eq=False, kw_only=True)
class VehicleShape:
    """The surface of one vehicle."""

    field_m: Float[Tensor, "x y z"]
    """Signed distances at the nodes of the half grid."""
    shares: Float[Tensor, "materials x y z"]
    """Of the materials at the surface nearest to each node."""
    size_m: Float[Tensor, "3"]
    """Of the box, stretched as the fit found."""
    yaw_rad: Float[Tensor, ""]
    centre_m: Float[Tensor, "3"]
    """Of the shape's frame in the box frame."""

    def signed_distance(self, points_box: Float[Tensor, "points 3"]) -> Float[Tensor, " points"]:
        """Metres to the surface, negative inside, cut off at `TRUNCATION_M`."""
        own = self._own(points_box) / (self.size_m / 2)
        return _sampled(self.field_m[None], own)[:, 0]

    def materials(self, places: Float[Tensor, "places 3"]) -> Float[Tensor, "places materials"]:
        """Shares of `MATERIALS` that vehicles of this shape have at places on the surface."""
        found = _sampled(self.shares, self._own(places) / (self.size_m / 2)).clamp(min=0)
        return found / found.sum(1, keepdim=True).clamp(min=1e-6)

    def mirrored(self, points_box: Float[Tensor, "points 3"]) -> Float[Tensor, "points 3"]:
        """Points on the other side of the plane of symmetry."""
        beside_m = (points_box - self.centre_m) @ self.normal
        return points_box - 2 * beside_m[:, None] * self.normal

    @property
    def normal(self) -> Float[Tensor, "3"]:
        """Unit normal of the plane of symmetry, to the left; the plane holds `centre_m`."""
        return self._box_from_own[:, 1]

    def _own(self, points_box: Float[Tensor, "points 3"]) -> Float[Tensor, "points 3"]:
        """Points in the frame of the shape."""
        return (points_box - self.centre_m) @ self._box_from_own

    def rotation_to(self, other: "VehicleShape") -> Float[Tensor, "3 3"]:
        """Turns directions in this box into those in the box where the same vehicle is `other`."""
        return other._box_from_own @ self._box_from_own.T

    def carried_to(
        self, other: "VehicleShape", points_box: Float[Tensor, "points 3"]
    ) -> Float[Tensor, "points 3"]:
        """Places on this vehicle, in the frame of the box where the same vehicle is `other`."""
        return (points_box - self.centre_m) @ self.rotation_to(other).T + other.centre_m

    def surface(
        self, spacing_m: float
    ) -> tuple[Float[Tensor, "places 3"], Float[Tensor, "places 3"]]:
        """Places on the surface about so far apart, and unit normals out of it."""
        half_m = REACH * self.size_m.abs() / 2
        axes = [torch.arange(-float(h), float(h), spacing_m) for h in half_m]
        places = torch.cartesian_prod(*axes) + self.centre_m
        places = places[self.signed_distance(places).abs() < 0.75 * spacing_m]
        for _ in range(3):
            normal, slope = self._normals(places)
            step_m = (self.signed_distance(places) / slope).clamp(-spacing_m, spacing_m)
            places = places - step_m[:, None] * normal
        on_it = self.signed_distance(places).abs() < 0.25 * spacing_m
        places, normal = places[on_it], normal[on_it]
        cell = ((places - places.amin(0)) / (0.9 * spacing_m)).floor().long()
        _, which = torch.unique(cell, dim=0, return_inverse=True)
        first = torch.full((int(which.max()) + 1,), len(which)).scatter_reduce(
            0, which, torch.arange(len(which)), "amin"
        )
        wheels, facing = self._wheels(spacing_m)
        return torch.cat([places[first], wheels]), torch.cat([normal[first], facing])

    def _wheels(
        self, spacing_m: float
    ) -> tuple[Float[Tensor, "places 3"], Float[Tensor, "places 3"]]:
        """Outer faces and treads of four wheels that stand on the bottom of the box."""
        half_m = self.size_m / 2
        radius_m = float(WHEEL_RADIUS * self.size_m[0])
        axis = torch.arange(-radius_m, radius_m, spacing_m)
        across, up = torch.cartesian_prod(axis, axis).unbind(1)
        disc = torch.stack([across, torch.zeros_like(across), up], dim=1)
        disc = disc[disc.norm(dim=1) < radius_m]
        turn = torch.arange(math.pi, 2 * math.pi, spacing_m / radius_m)
        depth = torch.arange(0, TREAD_M, spacing_m)
        angle, inward = torch.cartesian_prod(turn, -depth).unbind(1)
        radial = torch.stack([angle.cos(), torch.zeros_like(angle), angle.sin()], dim=1)
        tread = radius_m * radial + inward[:, None] * torch.tensor([0.0, 1.0, 0.0])
        left = torch.tensor([0.0, 1.0, 0.0]).expand_as(disc)
        places, normals = torch.cat([disc, tread]), torch.cat([left, radial])
        parts = []
        for axle in WHEELS_AT:
            for side in (1.0, -1.0):
                turned = torch.tensor([1.0, side, 1.0])
                hub = torch.stack(
                    [axle * half_m[0], side * WHEEL_BESIDE * half_m[1], radius_m - half_m[2]]
                )
                parts.append((places * turned + hub, normals * turned))
        own, facing = (torch.cat(some) for some in zip(*parts, strict=True))
        rotation = self._box_from_own
        return own @ rotation.T + self.centre_m, facing @ rotation.T

    @property
    def _box_from_own(self) -> Float[Tensor, "3 3"]:
        cosine, sine, zero = self.yaw_rad.cos(), self.yaw_rad.sin(), torch.zeros(())
        rows = [[cosine, -sine, zero], [sine, cosine, zero], [zero, zero, zero + 1]]
        return torch.stack([torch.stack(row) for row in rows])

    def _normals(
        self, places: Float[Tensor, "places 3"]
    ) -> tuple[Float[Tensor, "places 3"], Float[Tensor, " places"]]:
        """Unit gradients of the distance, and how long they were."""
        step_m = 0.06
        shifts = step_m * torch.eye(3)
        gradient = torch.stack(
            [
                self.signed_distance(places + shift) - self.signed_distance(places - shift)
                for shift in shifts
            ],
            dim=1,
        ) / (2 * step_m)
        length = gradient.norm(dim=1).clamp(min=0.2)
        return torch.nn.functional.normalize(gradient, dim=1), length


@dataclass(frozen=True, eq=False)
class _Model:
    """All vehicles that can be."""

    mean_m: Float[Tensor, "x y z"]
    axes_m: Float[Tensor, "axes x y z"]
    shares: Float[Tensor, "terms materials x y z"]
    """The mean, then what the first latent numbers add."""

    def shaped(
        self, latent: Float[Tensor, " axes"], frame: Float[Tensor, "7"], size_m: Float[Tensor, "3"]
    ) -> VehicleShape:
        """The vehicle of latent numbers; `frame` is shift, yaw and stretch in deviations."""
        terms = latent[: len(self.shares) - 1].detach()
        return VehicleShape(
            field_m=self.mean_m + torch.tensordot(latent, self.axes_m, dims=1),
            shares=self.shares[0] + torch.tensordot(terms, self.shares[1:], dims=1),
            size_m=size_m * (_STRETCH * frame[4:]).exp(),
            yaw_rad=_YAW_RAD * frame[3],
            centre_m=_SHIFT_M * frame[:3],
        )


@cache
def _bundled() -> _Model:
    tensors, _ = read_tensors(BUNDLED)
    shares = tensors["shares_i8"].float() * SHARE_STEP
    return _Model(tensors["mean_m"].float(), tensors["axes_m"].float(), shares)


@dataclass(frozen=True, eq=False)
class MeasuredPoints:
    """What was measured of one vehicle in one box, and of what is around it there."""

    points_box: Float[Tensor, "points 3"]
    weight: Float[Tensor, " points"]
    """What each says of the surface, against a point of LiDAR."""

    def thinned(self) -> "MeasuredPoints":
        """At most `MOST_POINTS` of them, evenly taken: as many as a fit looks at."""
        step = max(1, -(-len(self.weight) // MOST_POINTS))
        return MeasuredPoints(self.points_box[::step], self.weight[::step])


def fitted_shape(
    points_box: Float[Tensor, "points 3"],
    weight: Float[Tensor, " points"],
    size_m: Float[Tensor, "3"],
) -> VehicleShape:
    """The vehicle of a box whose surface goes through points, as far as they are none of others.

    Minimises weighted robust distances and the negative logarithm of the prior over latent numbers,
    place, heading and size of the shape. Without points it is the mean of vehicles in this box.
    """
    return fitted_shapes([MeasuredPoints(points_box, weight)], size_m)[0]


def fitted_shapes(
    measured: Sequence[MeasuredPoints], size_m: Float[Tensor, "3"]
) -> list[VehicleShape]:
    """One vehicle that was measured in several boxes, as it stands in each of them.

    Form and size are those of one rigid vehicle; place and heading in a box are its own, since
    boxes of one car differ by centimetres. `size_m` is of the first box.
    """
    model = _bundled()
    latent = torch.zeros(len(model.axes_m), requires_grad=True)
    places = torch.zeros(len(measured), 4, requires_grad=True)
    stretch = torch.zeros(3, requires_grad=True)
    told = []
    for row, one in enumerate(measured):
        if len(one.weight) >= LEAST_POINTS:
            few = one.thinned()
            told.append((row, few.points_box, few.weight / few.weight.sum() * EVIDENCE))
    optimiser = torch.optim.Adam([latent, places, stretch], lr=0.1)
    for _ in range(STEPS if told else 0):
        optimiser.zero_grad()
        loss = 0.5 * torch.cat([latent, places.flatten(), stretch]).square().sum()
        for row, points, weight in told:
            shape = model.shaped(latent, torch.cat([places[row], stretch]), size_m)
            ratio = (shape.signed_distance(points) / OUTLIER_M).square()
            loss = loss + (weight * ratio / (1 + ratio)).sum()
        loss.backward()
        optimiser.step()
    with torch.no_grad():
        return [model.shaped(latent, torch.cat([place, stretch]), size_m) for place in places]


def _sampled(
    fields: Float[Tensor, "fields x y z"], own: Float[Tensor, "points 3"]
) -> Float[Tensor, "points fields"]:
    """Half grids between their nodes; `own` is in half sizes."""
    x, y, z = own.unbind(1)
    at = torch.stack([z / REACH, 2 * y.abs() / REACH - 1, x / REACH], dim=1)
    found = torch.nn.functional.grid_sample(
        fields[None], at[None, None, None], align_corners=True, padding_mode="border"
    )
    return found[0, :, 0, 0].T
