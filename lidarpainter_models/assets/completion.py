"""Make a vehicle whole: what was seen of it, its mirror image, and for the rest a guess.

Box frame: x along the length, y left, z up, origin at the centre; metres.
"""

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree
from torch import Tensor

from lidarpainter_models.assets.seen_surfaces import SPACING_M, SeenSurface
from lidarpainter_models.editing.actor_models import DARKEST, ActorModel
from lidarpainter_models.gaussians.model.gaussian_set import GaussianSet, sh_from_rgb
from lidarpainter_models.geometry.transforms import quaternion_from_rotation

SEEN, MIRRORED, GUESSED = 0, 1, 2
ORIGINS = ("seen", "mirrored", "guessed")
MIRROR_REACH_M = 0.1
"""A place takes the colour of its mirror image if one was seen so near to it."""
OPACITY = 0.95
FLAT_M = 0.012
INSET_M = 0.04
"""Discs lie so far inside the surface: around bends they reach out of it."""
WIDE = 0.6
"""Deviation of a flat Gaussian along the surface, in spacings."""
NEIGHBOURS = 6
USUAL_RGB = (
    (0.2, 0.24, 0.3),
    (0.08, 0.08, 0.09),
    (0.8, 0.82, 0.84),
    (0.5, 0.08, 0.08),
    (0.4, 0.4, 0.42),
)
"""Of glass, tyres, lamps and rims, where the vehicle does not show its own."""
RIDGE = 20.0
"""So many places say as much of the colour of a material as is known beforehand."""
LIKE_M = 0.25
"""Farther off a known place tells nothing that its material does not."""


def coloured_places(
    surface: SeenSurface,
) -> tuple[Float[Tensor, "places 3"], Int[Tensor, " places"]]:
    """A colour for every place of a surface, and where it comes from."""
    seen = surface.is_seen
    rgb, origin = surface.rgb.clone(), torch.full((len(seen),), GUESSED)
    origin[seen] = SEEN
    if not bool(seen.any()):
        return rgb, origin
    rows = seen.nonzero()[:, 0]
    tree = cKDTree(surface.places[rows].numpy())
    hidden = (~seen).nonzero()[:, 0]
    image = surface.shape.mirrored(surface.places[hidden]).numpy()
    distance_m, nearest = tree.query(image, distance_upper_bound=MIRROR_REACH_M)
    is_near = torch.from_numpy(np.isfinite(distance_m))
    rgb[hidden[is_near]] = rgb[rows[torch.from_numpy(nearest)[is_near]]]
    origin[hidden[is_near]] = MIRRORED
    known = origin != GUESSED
    rgb[~known] = _guessed(surface, rgb, known)
    return rgb, origin


def _guessed(
    surface: SeenSurface, rgb: Float[Tensor, "places 3"], known: Bool[Tensor, " places"]
) -> Float[Tensor, "unknown 3"]:
    """Colours of places that nobody saw, by their materials, and by the nearest that is known.

    The colours of the materials are those that explain the known places best, drawn to `USUAL_RGB`
    where few are known (ridge regression, Hoerl and Kennard, 1970). What they leave unexplained of
    a known place holds for its surroundings too.
    """
    shares = surface.shape.materials(surface.places)
    terms = torch.cat([shares, shares[:, :1] * surface.normals[:, 2:]], dim=1)
    paint_rgb = _middle(rgb[known], shares[known, 0])
    usual = torch.cat([paint_rgb[None], torch.tensor(USUAL_RGB), torch.zeros(1, 3)])
    own = terms[known]
    square = own.T @ own + RIDGE * torch.eye(own.shape[1])
    colours = usual + torch.linalg.solve(square, own.T @ (rgb[known] - own @ usual))
    left = rgb[known] - own @ colours
    distance_m, nearest = cKDTree(_folded(surface)[known].numpy()).query(
        _folded(surface)[~known].numpy(), NEIGHBOURS
    )
    weight = torch.from_numpy(np.exp(-distance_m / LIKE_M)).float()[..., None]
    near = (weight * left[torch.from_numpy(nearest)]).mean(1)
    return terms[~known] @ colours + near


def _middle(rgb: Float[Tensor, "places 3"], share: Float[Tensor, " places"]) -> Float[Tensor, "3"]:
    """Median colour of the places that are most of one material."""
    most = share >= share.quantile(0.7)
    return rgb[most].median(dim=0).values


def _folded(surface: SeenSurface) -> Float[Tensor, "places 6"]:
    """Where a place is on one half of the vehicle, and how it faces: near is of like look."""
    x, y, z = surface.places.unbind(1)
    return torch.cat([torch.stack([x, y.abs(), z], dim=1), 0.3 * surface.normals], dim=1)


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


def completed(model: ActorModel, surface: SeenSurface) -> WholeActor:
    """The vehicle of a model with its whole surface."""
    rgb, origin = coloured_places(surface)
    gaussians = flat_gaussians(
        surface.places - INSET_M * surface.normals,
        surface.normals,
        rgb,
        sh_degree=model.gaussians.sh_degree,
    )
    return WholeActor(model=replace(model, gaussians=gaussians), origin=origin, surface=surface)
