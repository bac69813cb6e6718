"""Turn views of a fit whose true images are known into stored training pairs.

Each view gives one pair as the fit left it and further ones with damaged Gaussians. The fits come
from `harvest.py` (recorded logs) and `street_harvest.py` (synthetic streets).
"""

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from lidarpainter_models.conditioning.conditions import ConditionBuilder
from lidarpainter_models.gaussians.model.gaussian_scene import GaussianScene
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.observations.views import SceneObservations
from lidarpainter_models.painter.examples import PaintingPair
from lidarpainter_models.scenes.driving_scene import DrivingScene
from lidarpainter_models.training_data.corruptions import corrupt_gaussians
from lidarpainter_models.training_data.pairs import PairWriter
from lidarpainter_models.training_data.settings import HarvestConfig

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


def harvest_label(
    scene: DrivingScene,
    plan: object,
    config: HarvestConfig,
) -> str:
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
