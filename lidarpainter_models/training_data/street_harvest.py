"""Training pairs from synthetic streets: shifted views of a fit beside the exact truth.

No recorded log shows what a camera sees a lane aside; a synthetic street does. Its streets must
have other seeds than those of the demo and of the tests. World frame, z up; metres.
"""

from collections.abc import Sequence
from typing import Any

import torch
from jaxtyping import Float
from torch import Generator, Tensor

from lidarpainter_models.errors import SceneError
from lidarpainter_models.gaussians.fitting.fit import fit_gaussians
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.geometry.shifts import Shift
from lidarpainter_models.geometry.trajectories import road_directions, shift_pose
from lidarpainter_models.observations.image_shrinking import fit_camera
from lidarpainter_models.observations.preparation import prepare_observations
from lidarpainter_models.scenes.driving_scene import DrivingScene, RecordedView
from lidarpainter_models.scenes.splits import ViewSplit, split_views
from lidarpainter_models.synthetic.street import SyntheticStreet
from lidarpainter_models.training_data.harvest_targets import (
    HarvestProgress,
    Target,
    harvest_label,
    harvest_targets,
    is_harvested,
)
from lidarpainter_models.training_data.pairs import PairWriter
from lidarpainter_models.training_data.settings import HarvestConfig, StreetPlan

MOST_DRAWS = 20
"""Shifts tried per view before it is given up: the camera may stand in a wall every time."""
LATERAL_M = (1.0, 3.5)
UP_M = (0.5, 2.0)
YAW_RAD = 0.12  # largest turn of a view that is turned
LATERAL_SHARE = 0.7
"""Views moved sideways; the shares are independent, so some are moved in both ways or none."""
UP_SHARE = 0.35
YAW_SHARE = 0.25
CLEAR_M = 1.2
"""A view is drawn again if more than `CROWDED_SHARE` of its pixels are nearer than this."""
CROWDED_SHARE = 0.03


def harvest_shifted_street(
    street: SyntheticStreet,
    scene: DrivingScene,
    plans: Sequence[StreetPlan],
    writer: PairWriter,
    *,
    config: HarvestConfig,
    progress: HarvestProgress,
) -> int:
    """Fit a street several times and pair shifted renders with the truth.

    A harvest that was killed goes on where it stopped: a fit whose pairs are all stored is not
    repeated. The scene is its recording, as `write_street` stored it. The config's reference fit is
    not used, a street's poses are known.

    Returns:
        Number of pairs added.

    Raises:
        SceneError: the scene is no recording of this street, or all views stand inside things.
    """
    _check_recording(street, scene)
    added = 0
    for number, plan in enumerate(plans):
        split = split_views(scene, plan.split, plan.cameras)
        targets = _draw_targets(street, scene, split, plan, config)
        if not is_harvested([target.name for target in targets], writer, config):
            observations = prepare_observations(scene, split, config.observations)
            fitted = fit_gaussians(observations, plan.fit).scene
            added += harvest_targets(fitted, observations, targets, writer, config)
        progress(number + 1, len(plans))
    return added


def draw_shift(generator: Generator) -> Shift:
    """A random shift; the recorded pose itself if no kind of shift was drawn."""
    lateral, up, yaw, side, amount, height, angle = torch.rand(7, generator=generator).tolist()
    low, high = LATERAL_M
    lateral_m = (low + (high - low) * amount) * (1 if side < 0.5 else -1)
    low, high = UP_M
    return Shift(
        lateral_m=lateral_m if lateral < LATERAL_SHARE else 0.0,
        up_m=low + (high - low) * height if up < UP_SHARE else 0.0,
        yaw_rad=YAW_RAD * (2 * angle - 1) if yaw < YAW_SHARE else 0.0,
    )


def _draw_targets(
    street: SyntheticStreet,
    scene: DrivingScene,
    split: ViewSplit,
    plan: StreetPlan,
    config: HarvestConfig,
) -> list[Target]:
    """Views of the shifted camera, spread over all frames of the split, with their truth."""
    label = harvest_label(scene, plan, config)
    generator = torch.Generator().manual_seed(int(label.rsplit("-", 1)[1], 16))
    directions = road_directions(scene.world_from_ego)
    recorded = [view for view in (*split.train, *split.test) if view.camera_name == plan.cameras[0]]
    order = torch.randperm(len(recorded), generator=generator).tolist()
    targets: list[Target] = []
    for index in range(plan.num_views):
        view = recorded[order[index % len(order)]]
        row = scene.frame_indices.index(view.frame_index)
        found = _clear_view(street, view, directions[row], generator, config)
        if found is not None:
            camera, shift, true_rgb = found
            targets.append(
                Target(
                    name=f"{label}-{index:03d}",
                    camera=camera,
                    timestamp_ns=view.timestamp_ns,
                    camera_name=view.camera_name,
                    true_rgb=true_rgb,
                    provenance=_provenance(scene, plan, view, shift),
                )
            )
    if not targets:
        raise SceneError(f"{scene.path}: every shifted view stands inside things")
    return targets


def _clear_view(
    street: SyntheticStreet,
    view: RecordedView,
    road_direction: torch.Tensor,
    generator: Generator,
    config: HarvestConfig,
) -> tuple[Camera, Shift, Float[Tensor, "height width 3"]] | None:
    """A shifted view that does not stand inside something and its truth, or None."""
    recorded = fit_camera(view, config.observations)
    for _ in range(MOST_DRAWS):
        shift = draw_shift(generator)
        camera = recorded.at(shift_pose(recorded.world_from_camera, road_direction, shift))
        truth = street.render(camera, view.timestamp_ns)
        near = (truth.depth_m > 0) & (truth.depth_m < CLEAR_M)
        if float(near.float().mean()) <= CROWDED_SHARE:
            return camera, shift, truth.rgb.clamp(0, 1)
    return None


def _provenance(
    scene: DrivingScene, plan: StreetPlan, view: RecordedView, shift: Shift
) -> dict[str, Any]:
    return {
        "kind": "shifted street",
        "dataset": scene.dataset,
        "sequence": scene.sequence,
        "scene_digest": scene.content_digest,
        "frame": view.frame_index,
        "shift": shift.name,
        "split": plan.split,
        "cameras": list(plan.cameras),
        "fit_steps": plan.fit.steps,
    }


def _check_recording(street: SyntheticStreet, scene: DrivingScene) -> None:
    generator = scene.manifest.get("generator") or {}
    if generator.get("config", {}).get("seed") != street.config.seed:
        raise SceneError(
            f"{scene.path} is no recording of the street with seed {street.config.seed}"
        )
    for name, value in (("pose_noise_m", 0), ("pose_noise_rad", 0), ("camera_delay_s", 0)):
        if getattr(street.config, name) != value:
            raise SceneError(
                f"{scene.path}: a street gives pairs only with {name} = 0, so that the truth lies "
                "exactly over the render"
            )
