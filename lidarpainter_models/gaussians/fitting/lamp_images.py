"""What images have that a scene lacks, whether it comes and goes, and how lamps shine by it."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from lidarpainter_models.gaussians.fitting.images import FitImage
from lidarpainter_models.gaussians.model.blinking import NUM_NODES, Blinking, with_added_colour
from lidarpainter_models.gaussians.model.drawing import OPAQUE, draw_gaussians
from lidarpainter_models.gaussians.model.gaussian_scene import GaussianScene
from lidarpainter_models.gaussians.model.gaussian_set import SH_CONSTANT
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
        coloured = replace(gaussians, sh_dc=harmonics[:, :1], sh_rest=harmonics[:, 1:])
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


NEAREST_M = 0.2
"""Depth below which a lamp does not count as before a camera."""
STEADINESS = 0.3
"""Pixels with no change that each node of a lattice starts with."""
ROUNDS = 10
"""Iterations in which a lattice is fitted to its Gaussians."""


def with_measured_lamps(
    scene: GaussianScene, lamps: Blinking, looks: Sequence[Look], most: int
) -> GaussianScene:
    """The scene with these lamps, as images that may show one tell when and how they shine.

    Of more than `most` evenly chosen ones are looked at. A lamp that these do not show both on and
    off is left out.
    """
    gaussians = scene.gaussians
    every = torch.arange(len(lamps), device=scene.device)
    rows, lamp = lamps.inside(gaussians.means, gaussians.body_index, every)
    used = [look for look in looks if _may_show(scene, lamps, look)]
    used = used[:: max(-(-len(used) // most), 1)]
    if not used:
        return scene
    own = torch.full_like(gaussians.body_index, len(rows), dtype=torch.int64)
    own[rows] = torch.arange(len(rows), device=scene.device)
    pixels, error = (part[:-1] for part in series(scene, used, own, len(rows) + 1))
    in_lamp = [
        part.new_zeros(len(lamps), *part.shape[1:]).index_add(0, lamp, part)
        for part in (pixels, error)
    ]
    levels = two_levels(*in_lamp)
    is_seen = in_lamp[0] >= LEAST_PX
    both = levels.is_high.any(dim=1) & (is_seen & ~levels.is_high).any(dim=1)
    is_on, is_off = levels.is_high[lamp], (is_seen & ~levels.is_high & both[:, None])[lamp]
    off_rgb, off_px = _mean(pixels, error, is_off)
    on_rgb, on_px = _mean(pixels, error, is_on)
    change_px = off_px * on_px / (off_px + on_px).clamp(min=1e-9)
    dark = _fitted(lamps, gaussians.means[rows], lamp, off_rgb, off_px)
    lit = _fitted(lamps, gaussians.means[rows], lamp, on_rgb - off_rgb, change_px)
    darker = lamps.colours(dark, gaussians.means[rows], lamp)
    shining = _over_time(replace(lamps, lit_rgb=lit), used, is_seen, levels).kept(both)
    return replace(
        scene.with_gaussians(with_added_colour(gaussians, rows, darker)), blinking=shining
    )


def _may_show(scene: GaussianScene, lamps: Blinking, look: Look) -> bool:
    """Whether the middle of a lamp is in an image, or beside it by less than the lamp is wide."""
    bodies = scene.posed(look.camera, look.image.timestamp_ns).bodies[lamps.bodies.cpu()]
    x, y, z = (bodies[:, :3, :3] @ lamps.centre_m.cpu()[..., None] + bodies[:, :3, 3:])[..., 0].T
    camera, depth_m = look.camera, z.clamp(min=NEAREST_M)
    wide_px = lamps.size_m.cpu().amax(dim=1) * camera.fx_px / depth_m
    u, v = x / depth_m * camera.fx_px + camera.cx_px, y / depth_m * camera.fy_px + camera.cy_px
    is_shown = (z > NEAREST_M) & (u > -wide_px) & (u < camera.width_px + wide_px)
    return bool((is_shown & (v > -wide_px) & (v < camera.height_px + wide_px)).any())


def _mean(
    pixels: Float[Tensor, "rows images"],
    error: Float[Tensor, "rows images 3"],
    taken: Bool[Tensor, "rows images"],
) -> tuple[Float[Tensor, "rows 3"], Float[Tensor, " rows"]]:
    """What some images have more of colour where each Gaussian is, and of how many pixels."""
    total_px = torch.where(taken, pixels, 0.0).sum(dim=1)
    total = torch.where(taken[..., None], error, 0.0).sum(dim=1)
    return total / total_px.clamp(min=1e-6)[:, None], total_px


def _fitted(
    lamps: Blinking,
    means: Float[Tensor, "rows 3"],
    lamp: Int[Tensor, " rows"],
    rgb: Float[Tensor, "rows 3"],
    pixels: Float[Tensor, " rows"],
) -> Float[Tensor, "lamps nodes 3"]:
    """Lattices that have these colours where the Gaussians are, by how many pixels show them."""
    leaf = torch.zeros(len(lamps), NUM_NODES, 3, device=means.device, requires_grad=True)

    def at_nodes(of_rows: Float[Tensor, "rows 3"]) -> Float[Tensor, "lamps nodes 3"]:
        """Sums of what Gaussians have, each parted among the nodes around it."""
        with torch.enable_grad():
            (sums,) = torch.autograd.grad((lamps.colours(leaf, means, lamp) * of_rows).sum(), leaf)
        return sums

    total = at_nodes(pixels[:, None].expand(-1, 3)) + STEADINESS
    found = torch.zeros_like(total)
    for _ in range(ROUNDS):
        missing = rgb - lamps.colours(found, means, lamp)
        found = found + (at_nodes(pixels[:, None] * missing) - STEADINESS * found) / total
    return found


def _over_time(
    lamps: Blinking, looks: Sequence[Look], is_seen: Bool[Tensor, "lamps images"], levels: Levels
) -> Blinking:
    """The lamps with when they are on: as the images of a time say, in between where none does."""
    times_ns = torch.tensor([look.image.timestamp_ns for look in looks])
    knots_ns, at = torch.unique(times_ns, return_inverse=True)
    is_seen, is_high = is_seen.cpu().float(), levels.is_high.cpu().float()
    seen = torch.zeros(len(lamps), len(knots_ns)).index_add(1, at, is_seen)
    high = torch.zeros(len(lamps), len(knots_ns)).index_add(1, at, is_high)
    knots_s = (knots_ns - knots_ns[0]).numpy() * 1e-9
    is_lit = [
        np.interp(knots_s, knots_s[known], (high[row] / seen[row].clamp(min=1)).numpy()[known])
        if known.any()
        else np.zeros(len(knots_s))
        for row in range(len(lamps))
        for known in [(seen[row] > 0).numpy()]
    ]
    return replace(lamps, knots_ns=knots_ns, is_lit=torch.tensor(np.array(is_lit)).float().T)
