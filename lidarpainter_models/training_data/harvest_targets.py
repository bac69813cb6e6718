"""Turn views of a fit whose true images are known into stored training pairs.

Each view gives one pair as the fit left it and further ones with damaged Gaussians. The fits come
from `harvest.py` (recorded logs) and `street_harvest.py` (synthetic streets).
"""

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Generator, Tensor

from lidarpainter_models.conditioning.conditions import ConditionBuilder
from lidarpainter_models.gaussians.model.gaussian_scene import GaussianScene
from lidarpainter_models.gaussians.model.gaussian_set import SH_CONSTANT, GaussianSet, axes_at
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.observations.views import SceneObservations
from lidarpainter_models.painter.examples import PaintingPair
from lidarpainter_models.scenes.driving_scene import DrivingScene
from lidarpainter_models.training_data.pairs import PairWriter
from lidarpainter_models.training_data.settings import HarvestConfig

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
    up = axes_at(gaussians.rotation_wxyz, gaussians.log_scale.argmin(dim=1))[:, 2].abs()
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


HarvestProgress = Callable[[int, int], None]
"""Told after each fit how many of how many are done."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Target:
    """A view whose true image is known."""

    name: str
    """Unique within its fit; part of the pair's file name."""
    camera: Camera
    timestamp_ns: int
    camera_name: str | None
    """Whose exposure the true image has; None for that of the scene itself."""
    true_rgb: Float[Tensor, "height width 3"]
    provenance: dict[str, Any]
    hidden: Bool[Tensor, "height width"] | None = None
    """Where the true image shows the recording car itself."""


def harvest_label(scene: DrivingScene, plan: object, config: HarvestConfig) -> str:
    """First part of the names of a plan's pairs; another plan or config gives another one."""
    settings = hashlib.sha256(repr((plan, config, scene.content_digest)).encode()).hexdigest()
    return f"{scene.dataset}-{scene.sequence}-{settings[:8]}"


def is_harvested(names: Sequence[str], writer: PairWriter, config: HarvestConfig) -> bool:
    """Whether every pair of these targets is stored."""
    return all(
        pair_name(name, copy) in writer
        for name in names
        for copy in range(1 + config.corrupted_per_view)
    )


def pair_name(target_name: str, copy: int) -> str:
    """Name of a target's pair: copy 0 is as the fit left it, the others are damaged."""
    return f"{target_name}-{'fit' if copy == 0 else f'damaged{copy}'}"


def harvest_targets(
    scene: GaussianScene,
    observations: SceneObservations,
    targets: Sequence[Target],
    writer: PairWriter,
    config: HarvestConfig,
) -> int:
    """Store the pairs of some views of one fit; those already stored are passed over.

    Returns:
        Number of pairs added.
    """
    added = 0
    pristine = _builder(scene, observations, config)
    for target in targets:
        for copy in range(1 + config.corrupted_per_view):
            name = pair_name(target.name, copy)
            if name in writer:
                continue
            builder, seed = pristine, None
            if copy:
                seed = _seed_of(name, config.seed)
                around = target.camera.centre_world.float()
                damaged = corrupt_gaussians(scene.gaussians, around, seed=seed)
                builder = _builder(scene.with_gaussians(damaged), observations, config)
            provenance = target.provenance | {"corruption_seed": seed}
            writer.add(name, _pair(builder, target), provenance)
            added += 1
    return added


def _builder(
    scene: GaussianScene, observations: SceneObservations, config: HarvestConfig
) -> ConditionBuilder:
    return ConditionBuilder(
        scene, observations.lidar_map, observations.views, config=config.conditions
    )


def _pair(builder: ConditionBuilder, target: Target) -> PaintingPair:
    """The conditions at a target beside its true image."""
    conditions = builder.conditions(
        target.camera, target.timestamp_ns, camera_name=target.camera_name
    )
    everywhere = torch.ones(conditions.height_width_px, dtype=torch.bool)
    known = everywhere if target.hidden is None else ~target.hidden
    return PaintingPair(conditions=conditions, target_rgb=target.true_rgb, target_valid=known)


def _seed_of(name: str, seed: int) -> int:
    """A number that follows from a pair's name, so that a continued harvest repeats it."""
    return int.from_bytes(hashlib.sha256(f"{seed} {name}".encode()).digest()[:6], "big")
