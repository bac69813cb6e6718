"""Make a vehicle whole: what was seen of it, its mirror image, and for the rest a guess.

Box frame: x along the length, y left, z up, origin at the centre; metres.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from lidarpainter_models.assets.seen_surfaces import SeenSurface
from lidarpainter_models.editing.actor_models import DARKEST, ActorModel
from lidarpainter_models.gaussians.model.gaussian_set import GaussianSet, sh_from_rgb
from lidarpainter_models.geometry.transforms import quaternion_from_rotation
from lidarpainter_models.lidar.vehicle_colours import ORIGINS
from lidarpainter_models.lidar.vehicle_shapes import INSET_M, SPACING_M

OPACITY = 0.95
FLAT_M = 0.012
WIDE = 0.6
"""Deviation of a flat Gaussian along the surface, in spacings."""


def flat_gaussians(
    places: Float[Tensor, "places 3"],
    normals: Float[Tensor, "places 3"],
    rgb: Float[Tensor, "places 3"],
    *,
    sh_degree: int,
) -> GaussianSet:
    """A disc of one colour at every place of a surface."""
    count = len(places)
    other = torch.eye(3)[normals.abs().argmin(1)]
    first = torch.nn.functional.normalize(torch.linalg.cross(normals, other), dim=1)
    second = torch.linalg.cross(normals, first)
    rotation = torch.stack([first, second, normals], dim=2)
    scale_m = torch.tensor([WIDE * SPACING_M, WIDE * SPACING_M, FLAT_M])
    return GaussianSet(
        means=places,
        rotation_wxyz=quaternion_from_rotation(rotation),
        log_scale=scale_m.log().repeat(count, 1),
        opacity_logit=torch.full((count,), OPACITY).logit(),
        sh_dc=sh_from_rgb(rgb.clamp(DARKEST, 1)),
        sh_rest=torch.zeros(count, (sh_degree + 1) ** 2 - 1, 3),
        body_index=torch.zeros(count, dtype=torch.int32),
    )


@dataclass(frozen=True, eq=False, kw_only=True)
class WholeActor:
    """A model, and where each of its Gaussians comes from."""

    model: ActorModel
    origin: Int[Tensor, " gaussians"]
    """Index in `ORIGINS`."""
    surface: SeenSurface | None = None
    """Of a vehicle that was made whole; its places are those of the Gaussians."""

    @property
    def shares(self) -> dict[str, float]:
        """What share of its Gaussians comes from where, by `ORIGINS`."""
        counts = torch.bincount(self.origin, minlength=len(ORIGINS)) / max(1, len(self.origin))
        return dict(zip(ORIGINS, counts.tolist(), strict=True))

    def exposed_like(self, road_rgb: Float[Tensor, "3"]) -> "WholeActor":
        """The same in the light of another scene, told by the colour of its road."""
        return replace(self, model=self.model.exposed_like(road_rgb))


def completed(model: ActorModel, surface: SeenSurface) -> WholeActor:
    """The vehicle of a model with its whole surface."""
    rgb, origin = surface.known.coloured()
    gaussians = flat_gaussians(
        surface.places - INSET_M * surface.normals,
        surface.normals,
        rgb,
        sh_degree=model.gaussians.sh_degree,
    )
    return WholeActor(model=replace(model, gaussians=gaussians), origin=origin, surface=surface)
