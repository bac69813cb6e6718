"""What lights surfaces, what they are, and the air between them and a camera.

World: z up, metres. Light is linear, in units of display white.
"""

from dataclasses import dataclass

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
    """Beyond it a lamp lights nothing; its light fades to nothing there."""
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
    """As long as the surface is flat: 1 for a disc, 0 for a ball, which faces nowhere."""
    facing: Float[Tensor, " gaussians"]
    """Share of a lamp's light that it sends back when it faces the lamp."""
    least_facing: Float[Tensor, " gaussians"]
    """The same at a grazing angle."""


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
    """Of water on level ground, against a still puddle."""
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
    """By equal sectors of azimuth, from x towards y: light of what stands there, and the tangent
    of its height."""


LEAST_BASE = 0.05
"""Darker colours than this say too little of how a colour changes with the direction of view."""
MOST_GAIN = 2.0
"""Of what depends on the direction of view."""
SKYLINE_SOFTNESS = 0.15
"""Change of tangent over which sky takes over from what stands before it in a mirror."""
WIDEST_BEAM = 1.2
"""Tangent to the side beyond which nothing of a beam is left (4 deviations at 50 degrees)."""
FAINT = 9.0
"""Widths of the soft edge of a beam beyond which stray light alone is left."""
STRAY_REACH_M = 15.0
"""Beyond it nothing is left of what a beam loses above its cut-off."""
SH_CONSTANT = 0.28209479177387814  # value of the harmonic of degree 0
