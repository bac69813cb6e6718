"""Look up a sky texture, carry gradients back to it, and step Adam on the texels touched.

A texture covers a patch of the sphere of directions in equal steps of azimuth and elevation.
World frame: z up; azimuth is measured from x towards y, so columns run from left to right with
falling azimuth, rows from top to bottom with falling elevation. Angles are radians.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from lidarpainter_models.errors import ShapeError
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.kernels.backends import Backend, implementation


@dataclass(frozen=True, slots=True, kw_only=True)
class SkyLayout:
    """Which directions the texels of a sky texture stand for."""

    azimuth_left_rad: float
    elevation_top_rad: float
    texel_rad: float
    columns: int
    rows: int

    @property
    def wraps(self) -> bool:
        """Whether the texture runs all the way round, so that its sides meet."""
        return self.columns * self.texel_rad > 2 * math.pi - 0.5 * self.texel_rad


@dataclass(frozen=True, kw_only=True, eq=False)
class SkyRays:
    """Where the rays of a camera meet a sky texture."""

    places: Float[Tensor, "height width 2"]
    """Continuous (column, row), texel centres at +0.5; of pixels not wanted, anything."""
    wanted: Bool[Tensor, "height width"]
    """Pixels whose sky colour matters."""


@dataclass(frozen=True, kw_only=True, eq=False)
class TexelMoments:
    """Adam's moments of every texel, and how many steps it took; changed in place."""

    first: Float[Tensor, "rows columns 3"]
    second: Float[Tensor, "rows columns 3"]
    visits: Int[Tensor, "rows columns"]


def sky_rays(
    camera: Camera,
    layout: SkyLayout,
    wanted: Bool[Tensor, "height width"] | None = None,
    *,
    backend: Backend = "auto",
) -> SkyRays:
    """Where the camera's rays meet the texture; with `wanted`, only those of these pixels.

    Raises:
        ShapeError: `wanted` is not of the camera's size.
    """
    size = (camera.height_px, camera.width_px)
    if wanted is None:
        wanted = torch.ones(size, dtype=torch.bool)
    if wanted.shape != size:
        raise ShapeError(f"wanted pixels need shape {size}, got {tuple(wanted.shape)}")
    locate = implementation("sky_texture", "locate", backend, wanted.device)
    return SkyRays(places=locate(camera, layout, wanted), wanted=wanted)


def sample_sky(
    texture: Float[Tensor, "rows columns 3"],
    rays: SkyRays,
    layout: SkyLayout,
    *,
    backend: Backend = "auto",
) -> Float[Tensor, "height width 3"]:
    """Bilinear sky colour of the wanted pixels, black elsewhere; without gradient.

    Raises:
        ShapeError: the texture is not of the layout's size.
    """
    if texture.shape != (layout.rows, layout.columns, 3):
        raise ShapeError(f"a texture of {layout} has another shape than {tuple(texture.shape)}")
    sample = implementation("sky_texture", "sample", backend, texture.device, dtype=texture.dtype)
    return sample(texture.detach(), rays, layout)


def scatter_gradient(
    gradient: Float[Tensor, "height width 3"],
    weight: Float[Tensor, "height width"],
    rays: SkyRays,
    layout: SkyLayout,
    *,
    backend: Backend = "auto",
) -> tuple[Float[Tensor, "rows columns 3"], Float[Tensor, "rows columns"]]:
    """Carry pixel gradients to the texels: the transpose of `sample_sky`.

    Only pixels of positive weight count; they must be among the wanted ones. Returns the texels'
    gradients and the weights summed on each of them.

    Raises:
        ShapeError: gradient, weight and rays differ in size.
    """
    size = rays.wanted.shape
    if gradient.shape != (*size, 3) or weight.shape != size:
        raise ShapeError(
            f"need a gradient and a weight for each of {tuple(size)} rays, got "
            f"{tuple(gradient.shape)} and {tuple(weight.shape)}"
        )
    scatter = implementation(
        "sky_texture", "scatter", backend, gradient.device, dtype=gradient.dtype
    )
    return scatter(gradient, weight, rays, layout)


def step_texels(
    texture: Float[Tensor, "rows columns 3"],
    moments: TexelMoments,
    gradient: Float[Tensor, "rows columns 3"],
    weight: Float[Tensor, "rows columns"],
    learning_rate: float,
    *,
    backend: Backend = "auto",
) -> None:
    """One step of Adam (Kingma and Ba, 2015) on every texel of positive weight, in place.

    Each texel has a step count of its own; colours stay in [0, 1].

    Raises:
        ShapeError: the tensors differ in size.
    """
    if not texture.shape == gradient.shape == moments.first.shape == (*weight.shape, 3):
        raise ShapeError(
            f"texture, gradient and weight differ in size: {tuple(texture.shape)}, "
            f"{tuple(gradient.shape)}, {tuple(weight.shape)}"
        )
    step = implementation("sky_texture", "adam", backend, texture.device, dtype=texture.dtype)
    step(texture, moments, gradient, weight, learning_rate)
