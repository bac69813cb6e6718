"""How right a vehicle that was made whole is expected to look, direction by direction.

The PSNR against the true vehicle is predicted by a linear model of what publishing measures. Its
coefficients are of `scripts/calibrate_assets.py`, by the exact vehicles of synthetic streets.
Directions are those from the middle of the box to the eye. Box frame: x along the length, y left,
z up, origin at the centre.
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from lidarpainter_models.assets.completion import WholeActor
from lidarpainter_models.assets.sightings import Sighting
from lidarpainter_models.lidar.vehicle_colours import MIRRORED, SEEN

NUM_AZIMUTHS = 12
ELEVATIONS_DEG = (8.0, 30.0)
WORST_DB, BEST_DB = 12.0, 26.0
"""From nothing that looks like it to what a good fit of few images gives: scores 0 and 1."""
EVIDENCE = ("one", "seen", "mirrored", "away", "fineness", "hidden", "contrast", "disagreement")
"""What is measured of a direction:

- `one`: 1;
- `seen`, `mirrored`: shares of the surface that faces it;
- `away`: angle to the nearest look, in half turns;
- `fineness`: binary logarithm of the pixels per metre of the nearest image;
- `hidden`: share of the vehicle that others hid, over all images;
- `contrast`: decimal logarithm of the variance of its colours: plain ones are easily right;
- `disagreement`: decimal logarithm of the variance between looks at the same place.
"""
COEFFICIENTS_DB = (-5.431, 5.087, 0.213, 0.454, 1.555, -1.09, -7.879, -0.499)
"""In the order of `EVIDENCE`: of 24 directions of 48 vehicles, of the streets of seeds 421 to 426.

Streets that the numbers were not fitted to are ranked with a Spearman correlation of 0.83.
"""
_LEAST_VARIANCE = 1e-4


def directions() -> Float[Tensor, "directions 2"]:
    """Azimuth and elevation in radians, all of one elevation before those of the next."""
    azimuth = torch.arange(NUM_AZIMUTHS) * (2 * math.pi / NUM_AZIMUTHS)
    return torch.cartesian_prod(torch.tensor(ELEVATIONS_DEG).deg2rad(), azimuth).flip(1)


def evidence_of(
    whole: WholeActor,
    sighting: Sighting,
    like: Float[Tensor, "directions evidence"] | None = None,
) -> Float[Tensor, "directions evidence"]:
    """What is known of each direction, by `EVIDENCE`.

    `like` is the evidence of another sighting of the same vehicle: how much colours vary is taken
    from there, since it grows with the exposure and the parts that were seen, not with the error.

    Raises:
        ValueError: the actor was not made whole.
    """
    surface = whole.surface
    if surface is None:
        raise ValueError("an actor without a surface has no evidence by direction")
    to_eye = _unit(directions())
    facing = (to_eye @ surface.normals.T).clamp(min=0)
    facing = facing / facing.sum(1, keepdim=True)
    looks = [[look.azimuth_deg, look.elevation_deg] for look in sighting.near_looks]
    cosine = (to_eye @ _unit(torch.tensor(looks).reshape(-1, 2).deg2rad()).T).clamp(-1, 1)
    known = surface.is_seen
    spread = surface.disagreement[known].median()
    of_all = [
        math.log2(max(1.0, sighting.pixels_per_m)),
        sighting.occlusion,
        math.log10(max(_LEAST_VARIANCE, float(surface.rgb[known].var(0).mean()))),
        math.log10(max(_LEAST_VARIANCE, float(spread))),
    ]
    found = torch.cat(
        [
            torch.ones(len(to_eye), 1),
            torch.stack([facing @ (whole.origin == one).float() for one in (SEEN, MIRRORED)], 1),
            cosine.amax(1, keepdim=True).acos() / math.pi,
            torch.tensor(of_all).expand(len(to_eye), len(of_all)),
        ],
        dim=1,
    )
    if like is not None:
        found[:, -2:] = like[:, -2:]  # contrast and disagreement
    return found


def expected_psnr_db(
    evidence: Float[Tensor, "directions evidence"],
) -> Float[Tensor, " directions"]:
    """PSNR against the true vehicle that is to be expected from each direction."""
    return evidence @ torch.tensor(COEFFICIENTS_DB)


def score_of(psnr_db: Float[Tensor, " directions"]) -> float:
    """Score from 0 to 1: the mean over directions between `WORST_DB` and `BEST_DB`."""
    return min(1.0, max(0.0, (float(psnr_db.mean()) - WORST_DB) / (BEST_DB - WORST_DB)))


def _unit(angles_rad: Float[Tensor, "directions 2"]) -> Float[Tensor, "directions 3"]:
    azimuth, elevation = angles_rad.unbind(1)
    flat = elevation.cos()
    return torch.stack([flat * azimuth.cos(), flat * azimuth.sin(), elevation.sin()], dim=1)
