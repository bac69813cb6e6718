"""Look-ups in a sky texture, their transpose, and Adam on the texels touched; see `layout`."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from lidarpainter_models.errors import ShapeError
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.kernels.backends import Backend, float32_backend, implementation
from lidarpainter_models.kernels.sky_texture.layout import SkyLayout, SkyRays, TexelMoments

__all__ = [
    "SkyLayout",
    "SkyRays",
    "TexelMoments",
    "sample_sky",
    "scatter_gradient",
    "sky_rays",
    "step_texels",
]


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
    sample = implementation(
        "sky_texture", "sample", float32_backend("sky_texture", backend, texture), texture.device
    )
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
        "sky_texture", "scatter", float32_backend("sky_texture", backend, gradient), gradient.device
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
    step = implementation(
        "sky_texture", "adam", float32_backend("sky_texture", backend, texture), texture.device
    )
    step(texture, moments, gradient, weight, learning_rate)
