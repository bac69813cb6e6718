"""Light of Gaussians under lamps, on wet ground and through air, as one camera sees it.

A lamp at distance d gives power / (d^2 + 2) times the cosine to the normal, a dipped beam further
the share of its direction (`weather.darkness.dipped_beam`). A wet level surface mirrors as much as
Fresnel's law says. Air attenuates by exp(-beta d) and adds its own light (Koschmieder, 1924).
"""

from jaxtyping import Float
from torch import Tensor

from lidarpainter_models.errors import ShapeError
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.kernels.backends import Backend, implementation
from lidarpainter_models.kernels.frustum_culling.blocks import frustum_of
from lidarpainter_models.kernels.scene_light.parts import (
    LEAST_BASE,
    Appearance,
    Lamps,
    Surfaces,
    Surroundings,
)

__all__ = [
    "LEAST_BASE",
    "Appearance",
    "Lamps",
    "Surfaces",
    "Surroundings",
    "irradiance",
    "seen_harmonics",
]


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
