"""Damage a fitted scene the way too few views damage it, so that a painter can learn to undo it.

Every function takes Gaussians and gives damaged copies: balls left out, faded, thinned or shaken,
needles, false colours, and lane paint torn to dashes. Places are drawn among the Gaussians around a
point of interest, usually the camera, because damage far away is not seen. World frame, z up,
metres; actors' Gaussians stay in their box frames and are damaged with all others where a kind of
damage needs no place.
"""

from collections.abc import Callable
from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Generator, Tensor

from lidarpainter_models.gaussians.model.gaussian_set import SH_CONSTANT, GaussianSet
from lidarpainter_models.geometry.transforms import rotation_from_quaternion

LUMINANCE = (0.299, 0.587, 0.114)  # ITU-R BT.601
KINDS = (2, 4)  # different kinds of damage in one scene
REACH_M = 40.0  # balls are drawn around Gaussians at most this far from the point of interest
BALLS = (6, 30)  # places of one kind of damage
RADIUS_SHARE = (0.02, 0.09)
"""Radius of a ball, as a share of its distance from the point of interest."""
JITTER_M = (0.03, 0.25)
NEEDLE_SHARE = (0.001, 0.01)  # Gaussians that become needles
NEEDLE_STRETCH = (4.0, 12.0)
RECOLOUR_SHARE = (0.02, 0.15)  # Gaussians that take a false colour


def corrupt_gaussians(
    gaussians: GaussianSet, around_world: Float[Tensor, "3"], *, seed: int
) -> GaussianSet:
    """A copy with several random kinds of damage around a point; follows from the seed."""
    generator = torch.Generator().manual_seed(seed)
    low, high = KINDS
    number = low + int(torch.randint(high - low + 1, (), generator=generator))
    order = torch.randperm(len(_KINDS), generator=generator)[:number].tolist()
    damaged = gaussians.select(torch.arange(len(gaussians)))
    for index in sorted(order, reverse=True):  # dropping rows comes last
        if len(damaged) > 0:
            damaged = _KINDS[index](damaged, around_world, generator)
    return damaged


def drop_balls(
    gaussians: GaussianSet, around_world: Float[Tensor, "3"], generator: Generator
) -> GaussianSet:
    """Leave out everything in some balls: holes through which the background shows."""
    inside = random_balls(gaussians, around_world, generator)
    return gaussians.select((~inside).nonzero()[:, 0])


def fade_balls(
    gaussians: GaussianSet, around_world: Float[Tensor, "3"], generator: Generator
) -> GaussianSet:
    """Make balls translucent."""
    inside = random_balls(gaussians, around_world, generator)
    loss = _between((1.0, 4.0), generator)
    return replace(gaussians, opacity_logit=gaussians.opacity_logit - loss * inside)


def thin_balls(
    gaussians: GaussianSet, around_world: Float[Tensor, "3"], generator: Generator
) -> GaussianSet:
    """Shrink the Gaussians of some balls, so that a surface shows gaps as from nearby."""
    inside = random_balls(gaussians, around_world, generator)
    loss = _between((0.3, 0.9), generator)
    return replace(gaussians, log_scale=gaussians.log_scale - loss * inside[:, None])


def shake_balls(
    gaussians: GaussianSet, around_world: Float[Tensor, "3"], generator: Generator
) -> GaussianSet:
    """Move the Gaussians of some balls at random: surfaces crumble."""
    inside = random_balls(gaussians, around_world, generator)
    spread_m = _between(JITTER_M, generator)
    noise = spread_m * torch.randn(gaussians.means.shape, generator=generator)
    return replace(gaussians, means=gaussians.means + noise * inside[:, None])


def grow_needles(
    gaussians: GaussianSet,
    around_world: Float[Tensor, "3"],  # noqa: ARG001 - one signature for all kinds
    generator: Generator,
) -> GaussianSet:
    """Stretch some Gaussians along their longest axis and turn them anywhere."""
    chosen = _some(gaussians, NEEDLE_SHARE, generator)
    stretch = torch.tensor(_between(NEEDLE_STRETCH, generator)).log()
    longest = gaussians.log_scale.argmax(dim=1, keepdim=True)
    is_longest = torch.zeros_like(gaussians.log_scale).scatter_(1, longest, 1.0)
    change = stretch * (is_longest - 0.25 * (1 - is_longest)) * chosen[:, None]
    turned = torch.randn(gaussians.rotation_wxyz.shape, generator=generator)
    rotation = torch.where(chosen[:, None], turned, gaussians.rotation_wxyz)
    return replace(gaussians, log_scale=gaussians.log_scale + change, rotation_wxyz=rotation)


def recolour(
    gaussians: GaussianSet,
    around_world: Float[Tensor, "3"],  # noqa: ARG001
    generator: Generator,
) -> GaussianSet:
    """Give some Gaussians a colour of their own: rainbow speckle."""
    chosen = _some(gaussians, RECOLOUR_SHARE, generator)
    noise = _between((0.1, 0.5), generator) * torch.randn(
        gaussians.sh_dc.shape, generator=generator
    )
    change = noise / SH_CONSTANT * chosen[:, None, None]
    return replace(gaussians, sh_dc=gaussians.sh_dc + change)


def tear_lane_paint(
    gaussians: GaussianSet,
    around_world: Float[Tensor, "3"],  # noqa: ARG001
    generator: Generator,
) -> GaussianSet:
    """Give bright flat ground the colour of the road in stripes: lines break into dashes."""
    paint = is_bright_ground(gaussians)
    road = gaussians.sh_dc[is_flat(gaussians)]
    if len(road) == 0:
        return gaussians
    angle = torch.tensor(_between((0.0, torch.pi), generator))
    period_m = _between((0.4, 3.0), generator)
    along_m = gaussians.means[:, 0] * angle.cos() + gaussians.means[:, 1] * angle.sin()
    torn = paint & ((along_m / period_m) % 1 < _between((0.3, 0.7), generator))
    grey = road.median(dim=0).values
    return replace(gaussians, sh_dc=torch.where(torn[:, None, None], grey, gaussians.sh_dc))


def random_balls(
    gaussians: GaussianSet, around_world: Float[Tensor, "3"], generator: Generator
) -> Bool[Tensor, " gaussians"]:
    """Marks the street's Gaussians inside random balls around the point of interest."""
    distance_m = (gaussians.means - around_world.to(gaussians.means)).norm(dim=1)
    is_street = gaussians.body_index == 0
    near = (is_street & (distance_m < REACH_M)).nonzero()[:, 0]
    inside = torch.zeros_like(is_street)
    if len(near) == 0:
        return inside
    low, high = BALLS
    for _ in range(low + int(torch.randint(high - low + 1, (), generator=generator))):
        centre = near[int(torch.randint(len(near), (), generator=generator))]
        radius_m = float(distance_m[centre]) * _between(RADIUS_SHARE, generator)
        apart_m = (gaussians.means - gaussians.means[centre]).norm(dim=1)
        inside |= is_street & (apart_m < radius_m)
    return inside


def is_flat(gaussians: GaussianSet) -> Bool[Tensor, " gaussians"]:
    """Street Gaussians that lie like a plate on the ground: their thinnest axis points up."""
    rotation = rotation_from_quaternion(gaussians.rotation_wxyz)
    thinnest = gaussians.log_scale.argmin(dim=1)
    up = rotation[torch.arange(len(thinnest)), 2, thinnest].abs()
    return (up > 0.9) & (gaussians.body_index == 0)


def is_bright_ground(gaussians: GaussianSet) -> Bool[Tensor, " gaussians"]:
    """Flat Gaussians among the brightest eighth of all flat ones, where lane paint is."""
    flat = is_flat(gaussians)
    if not bool(flat.any()):
        return flat
    luminance = gaussians.base_rgb @ torch.tensor(LUMINANCE)
    return flat & (luminance > luminance[flat].quantile(0.875))


_KINDS: tuple[Callable[..., GaussianSet], ...] = (
    drop_balls,
    fade_balls,
    thin_balls,
    shake_balls,
    grow_needles,
    recolour,
    tear_lane_paint,
)


def _some(
    gaussians: GaussianSet, share: tuple[float, float], generator: Generator
) -> Bool[Tensor, " gaussians"]:
    return torch.rand(len(gaussians), generator=generator) < _between(share, generator)


def _between(ends: tuple[float, float], generator: Generator) -> float:
    return ends[0] + (ends[1] - ends[0]) * float(torch.rand((), generator=generator))
