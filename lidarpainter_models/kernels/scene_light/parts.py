"""What lights surfaces, what they are, and the air between them and a camera.

World: z up, metres. Light is linear, in units of display white.
"""

from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor


@dataclass(frozen=True, kw_only=True, eq=False)
class Lamps:
    """Lamps as they stand at one time."""

    position_world: Float[Tensor, "lamps 3"]
    heading_world: Float[Tensor, "lamps 3"]
    """Level unit vectors along which dipped beams point; zero for a lamp that shines all round."""
    power_rgb: Float[Tensor, "lamps 3"]
    """Irradiance a metre away; of a beam where it is brightest."""
    reach_m: Float[Tensor, " lamps"]
    """The distance at which a lamp's light has faded to nothing."""
    is_fixed: Bool[Tensor, " lamps"]
    """Whether the light of the street's surfaces holds this lamp's already."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Surfaces:
    """Gaussians as surfaces; what has a direction is in the frame of their body."""

    means: Float[Tensor, "gaussians 3"]
    body_index: Int[Tensor, " gaussians"]
    reach_m: Float[Tensor, " gaussians"]
    """How far a Gaussian may be seen beyond its centre."""
    normals: Float[Tensor, "gaussians 3"]
    """Normals whose length says how flat a surface is: 1 for a disc, 0 for a ball."""
    facing: Float[Tensor, " gaussians"]
    """Share of a lamp's light that it sends back when it faces the lamp."""
    least_facing: Float[Tensor, " gaussians"]
    """The same at a grazing angle."""

    @cached_property
    def body_radius_m(self) -> Float[Tensor, " bodies"]:
        """How far the centres of each body lie from its origin."""
        bodies = int(self.body_index.max()) + 1 if len(self.body_index) else 0
        farthest = self.means.new_zeros(bodies)
        return farthest.scatter_reduce(0, self.body_index.long(), self.means.norm(dim=1), "amax")


@dataclass(frozen=True, kw_only=True, eq=False)
class Appearance:
    """The light of surfaces before lamps that move, mirrors and air."""

    light: Float[Tensor, "gaussians 3"]
    reflectance: Float[Tensor, "gaussians 3"]
    """Share of a lamp's irradiance that is sent back."""
    harmonics: Float[Tensor, "gaussians rest 3"]
    """What depends on the direction of view: spherical harmonics of the displayed colour."""
    per_base: Float[Tensor, "gaussians 3"]
    """1 over the displayed colour that those belong to, at most 1 / `LEAST_BASE`."""
    shine: Float[Tensor, " gaussians"]
    """How much water on level ground mirrors, against a still puddle."""
    skyline: Int[Tensor, " gaussians"]
    """Row of what stands around a wet surface; -1 where it is under the open sky."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Surroundings:
    """What is seen through, and mirrored."""

    extinction_per_m: float
    airlight: Float[Tensor, "3"]
    sky_light: Float[Tensor, "3"]
    """What open sky shows a wet road."""
    skylines: Float[Tensor, "places sectors 4"]
    """Light of what stands in each of equal sectors of azimuth (from x towards y), and the tangent
    of its height."""


LEAST_BASE = 0.05
"""Darker colours than this say too little of how a colour changes with the direction of view."""
MOST_GAIN = 2.0
"""Most that harmonics of degree 1 and above are multiplied by."""
SKYLINE_SOFTNESS = 0.15
"""Change of tangent over which sky takes over from what stands before it in a mirror."""
WIDEST_BEAM = 1.2
"""Tangent to the side beyond which nothing of a beam is left (4 deviations at 50 degrees)."""
FAINT = 9.0
"""Widths of the soft edge of a beam beyond which stray light alone is left."""
STRAY_REACH_M = 15.0
"""Distance beyond which no stray light above a beam's cut-off is left."""
SH_CONSTANT = 0.28209479177387814  # value of the harmonic of degree 0


def lamps_that_reach(
    surfaces: Surfaces, world_from_body: Float[Tensor, "bodies 4 4"], lamps: Lamps
) -> Bool[Tensor, "bodies lamps"]:
    """Which lamps may reach anything of a body beyond what the light of its surfaces holds."""
    origins = world_from_body[:, :3, 3].to(lamps.position_world)
    radius_m = origins.new_zeros(len(origins))  # those of no surface stay 0
    radius_m[: len(surfaces.body_radius_m)] = surfaces.body_radius_m
    away_m = torch.cdist(origins, lamps.position_world)
    reaching = away_m < radius_m[:, None] + lamps.reach_m
    reaching[:1] &= ~lamps.is_fixed
    return reaching
