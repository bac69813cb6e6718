"""Make training pairs: damaged renders beside pictures that show what was really there.

A pair comes from a fit that saw too little, rendered where the truth is known: at recorded views
left out of the fit (`harvest_left_out`), or anywhere in a synthetic street (`street_harvest.py`).
Each view gives one pair as it is and further ones with damaged Gaussians. The true picture of a
view never lends its colours to the fit, the LiDAR or the warps of that view.
"""

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from lidarpainter_models.conditioning.conditions import ConditionBuilder, ConditionConfig
from lidarpainter_models.conditioning.corruptions import CorruptionConfig, corrupt_gaussians
from lidarpainter_models.conditioning.pairs import PairWriter
from lidarpainter_models.errors import ConfigError
from lidarpainter_models.gaussians.calibration import ViewKey
from lidarpainter_models.gaussians.densification import DensificationConfig
from lidarpainter_models.gaussians.fit import fit_gaussians
from lidarpainter_models.gaussians.fit_config import FitConfig, RefinementConfig
from lidarpainter_models.gaussians.observations import (
    ObservationConfig,
    SceneObservations,
    TrainingView,
    prepare_observations,
)
from lidarpainter_models.gaussians.scene_graph import GaussianScene
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.painter.examples import PaintingPair
from lidarpainter_models.scenes.driving_scene import DrivingScene
from lidarpainter_models.scenes.lidar_map import build_lidar_map
from lidarpainter_models.scenes.splits import ViewSplit

HarvestProgress = Callable[[int, int], None]
"""Told after each fit how many of how many are done."""

AS_GIVEN = RefinementConfig(cameras=False, extrinsics=False, actors=False)
"""Poses are not refined: those given are the best known, and the truth stands in their frame."""


def weak_fit(steps: int = 250, *, budget: int = 50_000) -> FitConfig:
    """A fit stopped early, on poses that are taken as they are."""
    return FitConfig(
        steps=steps,
        refinement=AS_GIVEN,
        densification=DensificationConfig(budget=budget),
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class HarvestConfig:
    """How pairs are made from a fit."""

    observations: ObservationConfig = field(default_factory=ObservationConfig)
    conditions: ConditionConfig = field(default_factory=ConditionConfig)
    corruption: CorruptionConfig = field(default_factory=CorruptionConfig)
    corrupted_per_view: int = 1
    """Pairs with damaged Gaussians beside the one that is as the fit left it."""
    reference_fit: FitConfig = field(default_factory=lambda: FitConfig(steps=1200))
    """The long fit to all training views whose refined poses the weak ones are judged at."""
    seed: int = 0

    def __post_init__(self) -> None:
        """Refuse a negative number of pairs."""
        if self.corrupted_per_view < 0:
            raise ConfigError(f"corrupted_per_view must be >= 0, got {self.corrupted_per_view}")


@dataclass(frozen=True, kw_only=True)
class LeftOutPlan:
    """One weak fit, and the frames it is judged at."""

    fit_frames: tuple[int, ...]
    target_frames: tuple[int, ...]
    fit: FitConfig = field(default_factory=weak_fit)
    with_all_sweeps: bool = False
    """Use the LiDAR of every training frame, as at a view shifted from the recorded path; without
    it only that of the frames fitted, as ahead of them."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Target:
    """A view whose true picture is known."""

    name: str
    """Unique within its fit; part of the pair's file name."""
    camera: Camera
    timestamp_ns: int
    camera_name: str | None
    """Whose exposure the true picture has; None for that of the scene itself."""
    true_rgb: Float[Tensor, "height width 3"]
    provenance: dict[str, Any]


def default_plans(train_frames: Sequence[int]) -> tuple[LeftOutPlan, ...]:
    """Weak fits that leave out what lies between, before and ahead of a few frames.

    Frames near the ends of the log are judged from fits that never came near, as shifted views
    are; the plans cover every training frame at least twice.
    """
    frames = tuple(train_frames)
    kept = {
        "every second": frames[0::2],
        "every third": frames[1::3],
        "first third": frames[: max(len(frames) // 3, 1)],
        "middle third": frames[len(frames) // 3 : max(2 * len(frames) // 3, 1)],
        "last third": frames[-max(len(frames) // 3, 1) :],
        "both ends": (frames[0], frames[-1]),
        "first half": frames[: max(len(frames) // 2, 1)],
    }
    plans = []
    for number, fit_frames in enumerate(dict.fromkeys(kept.values())):
        targets = tuple(frame for frame in frames if frame not in fit_frames)
        if fit_frames and targets:
            plans.append(
                LeftOutPlan(
                    fit_frames=fit_frames,
                    target_frames=targets,
                    fit=weak_fit(200 + 150 * (number % 3)),
                    with_all_sweeps=number % 2 == 0,
                )
            )
    return tuple(plans)


def harvest_left_out(
    scene: DrivingScene,
    split: ViewSplit,
    plans: Sequence[LeftOutPlan],
    writer: PairWriter,
    *,
    config: HarvestConfig | None = None,
    progress: HarvestProgress | None = None,
) -> int:
    """Judge weak fits at training frames left out of them, and store the pairs.

    A harvest that was killed goes on where it stopped. All poses are those of one long fit to
    every training view, so that the true picture lies exactly over the render.

    Args:
        scene: the recorded log.
        split: only its training views and training frames are ever read.
        plans: the weak fits.
        writer: where pairs go.
        config: see there.
        progress: told after every fit.

    Returns:
        Number of pairs added.

    Raises:
        ConfigError: a plan names a frame outside the training frames, or judges a frame it fits.
    """
    config = config or HarvestConfig()
    for plan in plans:
        check_plan(plan, split)
    observations = prepare_observations(scene, split, config.observations)
    reference = fit_gaussians(observations, config.reference_fit).scene
    aligned = _aligned(observations, reference)
    added = 0
    for number, plan in enumerate(plans):
        known = _observations_of(plan, scene, split, aligned)
        fitted = fit_gaussians(known, plan.fit).scene
        targets = [
            _left_out_target(view, plan, scene, number)
            for view in aligned.views
            if view.key[0] in plan.target_frames
        ]
        added += harvest_targets(fitted, known, targets, writer, config)
        if progress is not None:
            progress(number + 1, len(plans))
    return added


def check_plan(plan: LeftOutPlan, split: ViewSplit) -> None:
    """Hold what a painter learns from apart from what judges it.

    Raises:
        ConfigError: see `harvest_left_out`.
    """
    named = set(plan.fit_frames) | set(plan.target_frames)
    foreign = named - set(split.train_frames) | named & set(split.test_frames)
    if foreign:
        raise ConfigError(
            f"a harvest may use training frames only, not {sorted(foreign)}; "
            f"training frames are {sorted(split.train_frames)}"
        )
    both = set(plan.fit_frames) & set(plan.target_frames)
    if both or not plan.fit_frames or not plan.target_frames:
        raise ConfigError(
            f"a plan needs frames to fit and other frames to judge, got {plan.fit_frames} and "
            f"{plan.target_frames}"
        )


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
    pristine = ConditionBuilder(
        scene, observations.lidar_map, observations.views, config=config.conditions
    )
    for target in targets:
        for copy in range(1 + config.corrupted_per_view):
            name = f"{target.name}-{'fit' if copy == 0 else f'damaged{copy}'}"
            if name in writer:
                continue
            builder, seed = pristine, None
            if copy:
                seed = _seed_of(name, config.seed)
                builder = _damaged_builder(scene, observations, target, seed, config)
            provenance = target.provenance | {"corruption_seed": seed}
            writer.add(name, make_pair(builder, target), provenance)
            added += 1
    return added


def make_pair(builder: ConditionBuilder, target: Target) -> PaintingPair:
    """The conditions at a target beside its true picture."""
    conditions = builder.conditions(
        target.camera, target.timestamp_ns, camera_name=target.camera_name
    )
    return PaintingPair(
        conditions=conditions,
        target_rgb=target.true_rgb,
        target_valid=torch.ones(conditions.height_width_px, dtype=torch.bool),
    )


def _damaged_builder(
    scene: GaussianScene,
    observations: SceneObservations,
    target: Target,
    seed: int,
    config: HarvestConfig,
) -> ConditionBuilder:
    damaged = corrupt_gaussians(
        scene.gaussians,
        target.camera.centre_world.float(),
        seed=seed,
        config=config.corruption,
    )
    return ConditionBuilder(
        scene.with_gaussians(damaged),
        observations.lidar_map,
        observations.views,
        config=config.conditions,
    )


def _aligned(observations: SceneObservations, reference: GaussianScene) -> SceneObservations:
    """The observations at the reference fit's refined camera and actor poses."""
    views = tuple(
        replace(
            view,
            camera=reference.corrected_camera(
                view.camera,
                timestamp_ns=view.timestamp_ns,
                camera_name=view.key[1],
                key=view.key,
            ),
        )
        for view in observations.views
    )
    return replace(observations, views=views, tracks=reference.tracks)


def _observations_of(
    plan: LeftOutPlan, scene: DrivingScene, split: ViewSplit, aligned: SceneObservations
) -> SceneObservations:
    """What a plan's fit may see: its frames' views, and LiDAR coloured by them alone."""
    views = tuple(view for view in aligned.views if view.key[0] in plan.fit_frames)
    recorded = [view for view in split.train if view.frame_index in plan.fit_frames]
    lidar_map = build_lidar_map(
        scene,
        split_frames=split.train_frames if plan.with_all_sweeps else plan.fit_frames,
        colour_views=recorded,
    )
    return replace(aligned, views=views, lidar_map=lidar_map)


def _left_out_target(
    view: TrainingView, plan: LeftOutPlan, scene: DrivingScene, number: int
) -> Target:
    frame_index, camera_name = view.key
    key: ViewKey = view.key
    return Target(
        name=f"{scene.dataset}-{scene.sequence}-fit{number:02d}-{frame_index:04d}-{camera_name}",
        camera=view.camera,
        timestamp_ns=view.timestamp_ns,
        camera_name=camera_name,
        true_rgb=view.rgb,
        provenance={
            "kind": "left out",
            "dataset": scene.dataset,
            "sequence": scene.sequence,
            "scene_digest": scene.content_digest,
            "target": list(key),
            "fit_frames": list(plan.fit_frames),
            "fit_steps": plan.fit.steps,
            "with_all_sweeps": plan.with_all_sweeps,
        },
    )


def _seed_of(name: str, seed: int) -> int:
    """A number that follows from a pair's name, so that a continued harvest repeats it."""
    return int.from_bytes(hashlib.sha256(f"{seed} {name}".encode()).digest()[:6], "big")
