"""Colours of a vehicle's surface: what was seen of it, its mirror image, and for the rest a guess.

Box frame: x along the length, y left, z up, origin at the centre; metres.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree
from torch import Tensor

from lidarpainter_models.lidar.vehicle_shapes import VehicleShape

SEEN, MIRRORED, GUESSED = 0, 1, 2
ORIGINS = ("seen", "mirrored", "guessed")
MIRROR_REACH_M = 0.1
"""A place takes the colour of its mirror image if one was seen so near to it."""
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


@dataclass(frozen=True, kw_only=True, eq=False)
class VehiclePlaces:
    """Places on the surface of a vehicle, and the colours of those that were seen."""

    shape: VehicleShape
    places: Float[Tensor, "places 3"]
    normals: Float[Tensor, "places 3"]
    rgb: Float[Tensor, "places 3"]
    """Of places that nobody saw they mean nothing."""
    is_seen: Bool[Tensor, " places"]

    def coloured(self) -> tuple[Float[Tensor, "places 3"], Int[Tensor, " places"]]:
        """A colour for every place, and where it comes from (`ORIGINS`)."""
        seen = self.is_seen
        rgb, origin = self.rgb.clone(), torch.full((len(seen),), GUESSED)
        origin[seen] = SEEN
        if not bool(seen.any()):
            return rgb, origin
        rows = seen.nonzero()[:, 0]
        hidden = (~seen).nonzero()[:, 0]
        image = self.shape.mirrored(self.places[hidden]).numpy()
        tree = cKDTree(self.places[rows].numpy())
        distance_m, nearest = tree.query(image, distance_upper_bound=MIRROR_REACH_M)
        is_near = torch.from_numpy(np.isfinite(distance_m))
        rgb[hidden[is_near]] = rgb[rows[torch.from_numpy(nearest)[is_near]]]
        origin[hidden[is_near]] = MIRRORED
        known = origin != GUESSED
        rgb[~known] = self._guessed(rgb, known)
        return rgb, origin

    def _guessed(
        self, rgb: Float[Tensor, "places 3"], known: Bool[Tensor, " places"]
    ) -> Float[Tensor, "unknown 3"]:
        """Colours of places that nobody saw, by their materials, and by the nearest known ones.

        The colours of the materials are those that explain the known places best, drawn to
        `USUAL_RGB` where few are known (ridge regression, Hoerl and Kennard, 1970). What they leave
        unexplained of a known place holds for its surroundings too.
        """
        shares = self.shape.materials(self.places)
        terms = torch.cat([shares, shares[:, :1] * self.normals[:, 2:]], dim=1)
        paint_rgb = _middle(rgb[known], shares[known, 0])
        usual = torch.cat([paint_rgb[None], torch.tensor(USUAL_RGB), torch.zeros(1, 3)])
        own = terms[known]
        square = own.T @ own + RIDGE * torch.eye(own.shape[1])
        colours = usual + torch.linalg.solve(square, own.T @ (rgb[known] - own @ usual))
        left = rgb[known] - own @ colours
        folded = self._folded()
        distance_m, nearest = cKDTree(folded[known].numpy()).query(
            folded[~known].numpy(), [*range(1, min(NEIGHBOURS, int(known.sum())) + 1)]
        )
        weight = torch.from_numpy(np.exp(-distance_m / LIKE_M)).float()[..., None]
        near = (weight * left[torch.from_numpy(nearest)]).mean(1)
        return terms[~known] @ colours + near

    def _folded(self) -> Float[Tensor, "places 6"]:
        """Where places are on one half of the vehicle, and how they face: near is of like look."""
        x, y, z = self.places.unbind(1)
        return torch.cat([torch.stack([x, y.abs(), z], dim=1), 0.3 * self.normals], dim=1)


def _middle(rgb: Float[Tensor, "places 3"], share: Float[Tensor, " places"]) -> Float[Tensor, "3"]:
    """Median colour of the places that are most of one material."""
    most = share >= share.quantile(0.7)
    return rgb[most].median(dim=0).values
