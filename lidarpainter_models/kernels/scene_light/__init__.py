"""Light of Gaussians under lamps, on wet ground and through air, as one camera sees it.

A lamp at distance d gives power / (d^2 + 2) times the cosine to the normal, a dipped beam further
the share of its direction (`weather.darkness.dipped_beam`). A wet level surface mirrors as much as
Fresnel's law says. Air attenuates by exp(-beta d) and adds its own light (Koschmieder, 1924).

World: z up, metres. Light is linear, in units of display white.
"""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from lidarpainter_models.errors import ShapeError
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.kernels.backends import Backend, implementation
from lidarpainter_models.kernels.frustum_culling import frustum_of


class Lamps(NamedTuple):
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


class Surfaces(NamedTuple):
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

    body_radius_m: Float[Tensor, " bodies"]
    """How far the centres of each body lie from its origin, see `body_radii`."""


class Appearance(NamedTuple):
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


class Surroundings(NamedTuple):
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


def irradiance(
    surfaces: Surfaces,
    world_from_body: Float[Tensor, "bodies 4 4"],
    lamps: Lamps,
    *,
    backend: Backend = "auto",
) -> Float[Tensor, "gaussians 3"]:
    """What all lamps throw onto every surface and it can send back.

    Raises:
        ShapeError: a surface lies in no body.
    """
    _check_bodies(surfaces, world_from_body)
    lit = implementation("scene_light", "irradiance", backend, surfaces.means.device)
    return lit(surfaces, world_from_body, lamps)


def seen_harmonics(  # noqa: PLR0913 - surfaces, their light, and where everything stands
    surfaces: Surfaces,
    appearance: Appearance,
    surroundings: Surroundings,
    lamps: Lamps,
    camera: Camera | None,
    world_from_body: Float[Tensor, "bodies 4 4"],
    camera_from_body: Float[Tensor, "bodies 4 4"],
    *,
    backend: Backend = "auto",
) -> Float[Tensor, "gaussians coefficients 3"]:
    """Spherical harmonics of the displayed colour, constant first; zero where out of view.

    Without a camera everything is in view of an eye where `camera_from_body` says.

    Raises:
        ShapeError: surfaces and appearance differ in number, or a surface lies in no body.
    """
    if len(appearance.light) != len(surfaces.means):
        raise ShapeError(
            f"{len(surfaces.means)} surfaces have the light of {len(appearance.light)}"
        )
    _check_bodies(surfaces, camera_from_body)
    _check_bodies(surfaces, world_from_body)
    seen = implementation("scene_light", "seen_harmonics", backend, surfaces.means.device)
    frustum = None if camera is None else frustum_of(camera)
    return seen(
        surfaces, appearance, surroundings, lamps, frustum, world_from_body, camera_from_body
    )


def _check_bodies(surfaces: Surfaces, bodies: Float[Tensor, "bodies 4 4"]) -> None:
    last = int(surfaces.body_index.max()) if len(surfaces.body_index) else -1
    if last >= len(bodies):
        raise ShapeError(f"a surface lies in body {last} of {len(bodies)}")


def body_radii(
    means: Float[Tensor, "gaussians 3"], body_index: Int[Tensor, " gaussians"]
) -> Float[Tensor, " bodies"]:
    """How far the centres of each body lie from its origin, up to the last body that has any."""
    farthest = means.new_zeros(int(body_index.max()) + 1 if len(body_index) else 0)
    return farthest.scatter_reduce(0, body_index.long(), means.norm(dim=1), "amax")


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
