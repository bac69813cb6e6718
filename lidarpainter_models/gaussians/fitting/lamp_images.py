"""What images have that a scene lacks, place by place, and whether it comes and goes."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from lidarpainter_models.gaussians.fitting.images import FitImage
from lidarpainter_models.gaussians.model.drawing import OPAQUE, draw_gaussians
from lidarpainter_models.gaussians.model.gaussian_scene import GaussianScene
from lidarpainter_models.gaussians.model.gaussian_set import SH_CONSTANT
from lidarpainter_models.gaussians.model.seen_gaussians import SeenGaussians
from lidarpainter_models.geometry.cameras import Camera

LEAST_PX = 1.0
"""A place of which an image shows less than so many pixels is not seen by it."""
LEAST_IMAGES, LEAST_ON_A_LEVEL = 6, 2
"""Fewer images of a place prove nothing, nor does one that differs from all others."""


@dataclass(frozen=True, eq=False)
class Look:
    """An image and the refined camera that took it."""

    image: FitImage
    camera: Camera


@dataclass(frozen=True, eq=False)
class Levels:
    """What two levels of brightness explain of the changes of some places."""

    explained: Float[Tensor, " places"]
    change: Float[Tensor, " places"]
    is_high: Bool[Tensor, "places images"]
    """Which of the images that see a place show it on the higher level."""


def series(
    scene: GaussianScene, looks: Sequence[Look], group: Int[Tensor, " gaussians"], count: int
) -> tuple[Float[Tensor, "groups images"], Float[Tensor, "groups images 3"]]:
    """Pixels that groups of Gaussians have in each image, and what these lack of colour in all."""
    pixels, error = [], []
    for look in looks:
        own_px, own_error = lacking(scene, look)
        pixels.append(own_px.new_zeros(count).index_add(0, group, own_px))
        error.append(own_error.new_zeros(count, 3).index_add(0, group, own_error))
    return torch.stack(pixels, dim=1), torch.stack(error, dim=1)


def two_levels(
    pixels: Float[Tensor, "places images"], error: Float[Tensor, "places images 3"]
) -> Levels:
    """Part the images that see each place in two, by the channel that changes most (Otsu 1979)."""
    is_seen = pixels >= LEAST_PX
    level = torch.where(is_seen[..., None], error / pixels.clamp(min=LEAST_PX)[..., None], 0.0)
    count = is_seen.sum(dim=1).clamp(min=1)
    mean = level.sum(dim=1) / count[:, None]
    off = torch.where(is_seen[..., None], level - mean[:, None], 0.0)
    variance, channel = (off.square().sum(dim=1) / count[:, None]).max(dim=1)
    value = off.gather(2, channel[:, None, None].expand(-1, level.shape[1], 1))[..., 0]
    value, order = torch.where(is_seen, value, torch.inf).sort(dim=1)
    below = torch.arange(1, value.shape[1] + 1, device=value.device)
    above = count[:, None] - below
    low_sum = torch.where(value.isinf(), 0.0, value).cumsum(dim=1)  # all of them sum up to zero
    change = -low_sum / above.clamp(min=1) - low_sum / below
    between = below * above * change.square() / count[:, None].square()
    is_split = (below >= LEAST_ON_A_LEVEL) & (above >= LEAST_ON_A_LEVEL)
    is_split &= count[:, None] >= LEAST_IMAGES
    between, last_low = torch.where(is_split, between, 0.0).max(dim=1)
    is_high = torch.zeros_like(is_seen).scatter(1, order, below > last_low[:, None] + 1)
    rises = torch.where(is_high[..., None], off, 0.0).sum(dim=(1, 2)) > 0
    return Levels(
        explained=between / variance.clamp(min=1e-9),
        change=change.gather(1, last_low[:, None])[:, 0],
        is_high=(is_high == rises[:, None]) & is_seen,
    )


def lacking(
    scene: GaussianScene, look: Look
) -> tuple[Float[Tensor, " gaussians"], Float[Tensor, "gaussians 3"]]:
    """Pixels that each Gaussian has in an image, and what the image has more of colour in them.

    Both are sums over pixels by how much of each the Gaussian makes: gradients of the image.
    """
    image, camera = look.image.to(scene.device), look.camera
    with torch.no_grad():
        posed = scene.posed(camera, image.timestamp_ns)
        gaussians = posed.shown(scene.gaussians)
    harmonics = gaussians.sh.clone().requires_grad_(True)
    ones = torch.ones(len(gaussians), 1, device=scene.device, requires_grad=True)
    with torch.enable_grad():
        coloured = SeenGaussians.of(gaussians, harmonics)
        drawn = draw_gaussians(coloured, posed.bodies, camera, channels=ones)
        alpha = drawn.alpha.detach()
        sky_rgb = scene.sky.sample(scene.sky.rays(camera, alpha < OPAQUE))
        shown = drawn.rgb.detach() + (1 - alpha)[..., None] * sky_rgb
        recorded = image.facts().rgb
        true = scene.exposure.undone(recorded, image.camera_name, image.timestamp_ns)
        lacks = true - shown
        counts = torch.ones_like(alpha) if image.hidden is None else (~image.hidden).float()
        told = (drawn.rgb * lacks).sum(dim=-1) + drawn.features[..., 0]
        (counts * told).sum().backward()
    return _gradient(ones)[:, 0], _gradient(harmonics)[:, 0] / SH_CONSTANT


def _gradient(leaf: Tensor) -> Tensor:
    return torch.zeros_like(leaf) if leaf.grad is None else leaf.grad
