"""Make training pairs from a recorded log: fits that saw too little, judged where they did not.

A weak fit is rendered at recorded views left out of it, beside the images recorded there. The
image of a view never lends its colours to the fit, the LiDAR or the warps of that view, and only
training frames are read.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

from lidarpainter_models.errors import ConfigError
from lidarpainter_models.gaussians.fitting.config import FitConfig
from lidarpainter_models.gaussians.fitting.fit import fit_gaussians
from lidarpainter_models.gaussians.model.gaussian_scene import GaussianScene
from lidarpainter_models.lidar.map_building import build_lidar_map
from lidarpainter_models.lidar.whole_vehicles import with_whole_vehicles
from lidarpainter_models.observations.preparation import prepare_observations
from lidarpainter_models.observations.views import SceneObservations
from lidarpainter_models.scenes.driving_scene import DrivingScene
from lidarpainter_models.scenes.records import ViewKey
from lidarpainter_models.scenes.splits import ViewSplit
from lidarpainter_models.training_data.harvest_targets import (
    HarvestProgress,
    Target,
    harvest_label,
    harvest_targets,
    is_harvested,
)
from lidarpainter_models.training_data.pairs import PairWriter
from lidarpainter_models.training_data.settings import HarvestConfig, weak_fit


@dataclass(frozen=True, kw_only=True)
class LeftOutPlan:
    """One weak fit, and the frames it is judged at."""

    fit_frames: tuple[int, ...]
    target_frames: tuple[int, ...]
    fit: FitConfig = field(default_factory=weak_fit)
    with_all_sweeps: bool = False
    """Use the LiDAR of every training frame, as at a view shifted from the recorded path; without
    it only that of the frames fitted, as ahead of them."""


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
    config: HarvestConfig,
    progress: HarvestProgress,
) -> int:
    """Judge weak fits at training frames left out of them, and store the pairs.

    A harvest that was killed goes on where it stopped. All poses are those of one long fit to every
    training view, so that the true image lies exactly over the render. Only the split's training
    views and training frames are ever read.

    Returns:
        Number of pairs added.

    Raises:
        ConfigError: a plan names a frame outside the training frames, or judges a frame it fits.
    """
    for plan in plans:
        check_plan(plan, split)
    labels = [harvest_label(scene, plan, config) for plan in plans]
    wanted = [
        [
            _target_name(label, view.key)
            for view in split.train
            if view.frame_index in plan.target_frames
        ]
        for label, plan in zip(labels, plans, strict=True)
    ]
    if all(is_harvested(names, writer, config) for names in wanted):
        return 0
    observations = prepare_observations(scene, split, config.observations)
    reference = fit_gaussians(observations, config.reference_fit).scene
    aligned = _aligned(observations, reference)
    added = 0
    for number, (plan, label, names) in enumerate(zip(plans, labels, wanted, strict=True)):
        if not is_harvested(names, writer, config):
            known = _observations_of(plan, scene, split, aligned)
            fitted = fit_gaussians(known, plan.fit).scene
            targets = _left_out_targets(aligned, plan, scene, label)
            added += harvest_targets(fitted, known, targets, writer, config)
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


def _aligned(observations: SceneObservations, reference: GaussianScene) -> SceneObservations:
    """The observations at the reference fit's refined camera and actor poses."""
    views = tuple(
        replace(view, camera=reference.refined_camera(view)) for view in observations.views
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
    return replace(aligned, views=views, lidar_map=with_whole_vehicles(lidar_map, scene.tracks))


def _target_name(label: str, key: ViewKey) -> str:
    return f"{label}-{key[0]:04d}-{key[1]}"


def _left_out_targets(
    aligned: SceneObservations, plan: LeftOutPlan, scene: DrivingScene, label: str
) -> list[Target]:
    provenance = {
        "kind": "left out",
        "dataset": scene.dataset,
        "sequence": scene.sequence,
        "scene_digest": scene.content_digest,
        "fit_frames": list(plan.fit_frames),
        "fit_steps": plan.fit.steps,
        "with_all_sweeps": plan.with_all_sweeps,
    }
    return [
        Target(
            name=_target_name(label, view.key),
            camera=view.camera,
            timestamp_ns=view.timestamp_ns,
            camera_name=view.key[1],
            true_rgb=view.rgb,
            hidden=view.hidden,
            provenance=provenance | {"target": list(view.key)},
        )
        for view in aligned.views
        if view.key[0] in plan.target_frames
    ]
