"""A drawn image over its sky, with the terms that need no second image: sky and depth.

The regularisers are those that StreetCrafter (Yan et al., 2025) calls L_g: the sky stays clear,
LiDAR says how far things are. Depth is camera z in metres, alpha the opacity of the Gaussians.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from lidarpainter_models.errors import ShapeError
from lidarpainter_models.kernels.backends import Backend, float32_backend, implementation
from lidarpainter_models.kernels.gaussian_raster import SplatImage
from lidarpainter_models.kernels.pixel_losses.pixel_facts import (
    NOTHING,
    OPEN,
    SKY,
    SOLID,
    PixelFacts,
    PixelRules,
    PixelTerms,
)
from lidarpainter_models.kernels.pixel_losses.reference import clear_sky_loss, depth_loss

__all__ = [
    "NOTHING",
    "OPEN",
    "SKY",
    "SOLID",
    "PixelFacts",
    "PixelRules",
    "PixelTerms",
    "clear_sky_loss",
    "depth_loss",
    "pixel_terms",
]


def pixel_terms(
    image: SplatImage,
    sky_rgb: Float[Tensor, "height width 3"],
    facts: PixelFacts,
    rules: PixelRules,
    *,
    exposure: Float[Tensor, "3 4"] | None = None,
    backend: Backend = "auto",
) -> PixelTerms:
    """Put a drawn image over its sky and judge its alpha and depth; differentiable.

    `exposure` maps the colours of the scene to those that the camera shows, the last column being
    added; without it they are shown as they are.

    Raises:
        ShapeError: the images differ in size.
    """
    size = image.alpha.shape
    for name, tensor in (("sky_rgb", sky_rgb), ("rgb", facts.rgb), ("depth", facts.lidar_depth_m)):
        if tensor.shape[:2] != size:
            raise ShapeError(f"an image of {tuple(size)} needs {name} alike, got {tensor.shape}")
    terms = implementation(
        "pixel_losses",
        "pixel_terms",
        float32_backend("pixel_losses", backend, image.rgb),
        image.rgb.device,
    )
    if exposure is None:
        exposure = torch.eye(3, 4).to(image.rgb, non_blocking=True)
    return terms(image, sky_rgb, facts, rules, exposure)
