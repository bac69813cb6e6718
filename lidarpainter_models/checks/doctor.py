"""Tell whether a scene can be trusted, and where it cannot.

Each check looks at one thing that a wrong convention, a wrong clock or a damaged file would break,
and says what it measured. `fail` means that a reconstruction would be wrong, `warn` that a part of
it will be poor.
"""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from lidarpainter_models.checks.actors import (
    check_box_axes,
    check_box_points,
    check_duplicate_tracks,
    check_lasting_ids,
    check_own_boxes,
)
from lidarpainter_models.checks.box_places import check_box_places
from lidarpainter_models.checks.calibration import Agrees, check_calibration
from lidarpainter_models.checks.depth_edges import SceneEdges
from lidarpainter_models.checks.overlay import draw_overlay
from lidarpainter_models.checks.pictures import check_pictures
from lidarpainter_models.checks.swapped_images import check_swapped_images
from lidarpainter_models.checks.sweeps import (
    check_clear_air,
    check_coverage,
    check_ground,
    check_origins,
    check_sweeps_agree,
)
from lidarpainter_models.checks.traffic import check_traffic
from lidarpainter_models.errors import SceneError
from lidarpainter_models.geometry.transforms import (
    interpolate_rigid_track,
    invert_rigid,
    is_rigid,
    quaternion_from_rotation,
)
from lidarpainter_models.scenes.driving_scene import DrivingScene

__all__ = ["Check", "check_scene", "draw_overlay"]

Verdict = Literal["ok", "warn", "fail"]

MAX_SPEED_MPS = 60.0
MAX_SPEED_CHANGE_MPS2 = 15.0
MAX_TURN_RADPS = 2.0
MAX_CAMERA_LAG_S = 0.15
"""A camera takes its image while the LiDAR turns; farther apart is another frame's image."""
MAX_RIG_SPREAD_M = 0.15
_NON_COMMERCIAL = ("non-commercial", "noncommercial", "-nc-", " nc ", "-nc ")
_MIN_STEP_M = 0.2
"""From frame to frame; the poses of a car that stands jitter by less."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Check:
    """One finding about a scene."""

    name: str
    verdict: Verdict
    detail: str


def check_scene(
    scene: DrivingScene,
    agrees: Agrees = lambda _name, _turn: None,
    looking_at: Callable[[str], None] = lambda _name: None,
) -> list[Check]:
    """Run every check; the order is that in which a reader would debug a new dataset.

    Args:
        scene: what is checked.
        agrees: other evidence of how a camera is turned, see `check_calibration`.
        looking_at: told the name of each check before it is run.
    """
    edges = SceneEdges(scene)
    checks: tuple[tuple[str, Callable[[DrivingScene], tuple[Verdict, str]]], ...] = (
        ("stored content", check_content),
        ("licence", check_licence),
        ("ego poses", check_ego_poses),
        ("timestamps", check_timestamps),
        ("camera sync", check_camera_sync),
        ("camera rig", check_camera_rig),
        ("images", check_pictures),
        ("ground", check_ground),
        ("LiDAR origins", check_origins),
        ("sweeps agree", check_sweeps_agree),
        ("clear air", check_clear_air),
        ("points in images", check_coverage),
        ("camera calibration", lambda _: check_calibration(edges, agrees)),
        ("cameras in their place", lambda _: check_swapped_images(edges)),
        ("boxes hold points", check_box_points),
        ("boxes around points", check_box_places),
        ("boxes point ahead", check_box_axes),
        ("duplicate tracks", check_duplicate_tracks),
        ("lasting ids", check_lasting_ids),
        ("own boxes", check_own_boxes),
        ("unboxed traffic", check_traffic),
    )
    if scene.lidar_names:
        return [_run(name, check, scene, looking_at) for name, check in checks]
    without = "none: a fit takes its points from images, and what needs points is not checked"
    return [
        *(_run(name, check, scene, looking_at) for name, check in checks if name not in _BY_POINTS),
        Check(name="LiDAR", verdict="warn", detail=without),
    ]


def _run(
    name: str,
    check: Callable[[DrivingScene], tuple[Verdict, str]],
    scene: DrivingScene,
    looking_at: Callable[[str], None],
) -> Check:
    looking_at(name)
    try:
        verdict, detail = check(scene)
    except SceneError as error:  # a damaged part fails the checks that need it, not the others
        verdict, detail = "fail", str(error)
    except Exception as error:  # noqa: BLE001 - what one check cannot compute ends no run
        verdict, detail = "warn", not_computed(error)
    return Check(name=name, verdict=verdict, detail=detail)


def not_computed(error: Exception) -> str:
    """What is said of a finding that could not be computed."""
    said = (str(error) or "no message").splitlines()[0]
    return f"not checked: it could not be computed ({type(error).__name__}: {said})"


def check_content(scene: DrivingScene) -> tuple[Verdict, str]:
    """Whether every byte is what was written."""
    scene.verify_content()
    counts = scene.manifest["counts"]
    return "ok", ", ".join(f"{count} {name}" for name, count in counts.items())


def check_licence(scene: DrivingScene) -> tuple[Verdict, str]:
    """Whether it is said what may be done with the data."""
    licence = scene.manifest["licence"].strip()
    if not licence:
        return "fail", "the manifest names no licence: what may be done with the data is unknown"
    if any(word in licence.lower() for word in _NON_COMMERCIAL):
        return "ok", f"{licence} (no commercial use)"
    return "ok", licence


def check_ego_poses(scene: DrivingScene) -> tuple[Verdict, str]:
    """Whether the car moves as a car can."""
    if not bool(is_rigid(scene.world_from_ego).all()):
        return "fail", "a pose is not a rotation and a translation"
    if len(scene.frame_indices) < 2:
        return "warn", "a single frame: no motion to check"
    step_s = scene.frame_timestamps_ns.diff().double() / 1e9
    velocity = scene.world_from_ego[:, :3, 3].diff(dim=0) / step_s[:, None]
    speed = velocity.norm(dim=1)
    turn = _turn_rad(scene.world_from_ego[:-1], scene.world_from_ego[1:]) / step_s
    detail = f"speed {speed.min():.1f} to {speed.max():.1f} m/s, turn up to {turn.max():.2f} rad/s"
    if speed.median() > MAX_SPEED_MPS:
        return "fail", (
            f"the car drives at {speed.median():.3g} m/s throughout, no car does: times must be in "
            "nanoseconds, lengths in metres"
        )
    if speed.max() > MAX_SPEED_MPS or turn.max() > MAX_TURN_RADPS:
        worst = speed if speed.max() > MAX_SPEED_MPS else turn
        return "fail", f"{detail}: a jump at frame {_frame_after(scene, int(worst.argmax()))}"
    if _drives_across(scene.world_from_ego):
        return "fail", f"{detail}; the car drives across its x axis: is ego x forward, y left?"
    if len(speed) > 1:
        change = velocity.diff(dim=0).norm(dim=1) / step_s[1:]
        if change.max() > MAX_SPEED_CHANGE_MPS2:
            return "warn", (
                f"{detail}; speed changes by {change.max():.0f} m/s2 at frame "
                f"{_frame_after(scene, int(change.argmax()))}"
            )
    return "ok", detail


def check_timestamps(scene: DrivingScene) -> tuple[Verdict, str]:
    """Whether time runs forward, without gaps."""
    steps_s = scene.frame_timestamps_ns.diff().double() / 1e9
    for name in scene.camera_names:
        times_ns = [view.timestamp_ns for view in scene.views_of(name)]
        if any(later <= earlier for earlier, later in pairwise(times_ns)):
            return "fail", f"the times of {name} do not ascend"
    if len(steps_s) == 0:
        return "warn", "a single frame"
    middle_s = float(steps_s.median())
    gaps = int((steps_s > 1.5 * middle_s).sum())
    detail = f"{len(scene.frame_indices)} frames, every {1000 * middle_s:.0f} ms"
    return ("warn", f"{detail}, {gaps} gaps") if gaps else ("ok", detail)


def check_camera_sync(scene: DrivingScene) -> tuple[Verdict, str]:
    """Whether every image was taken while its frame's LiDAR turned."""
    sweep_ns = {sweep.frame_index: sweep.timestamp_ns for sweep in reversed(scene.sweeps)}
    lags, worst_s = [], 0.0
    for name in scene.camera_names:
        lag_s = [
            (view.timestamp_ns - sweep_ns[view.frame_index]) / 1e9
            for view in scene.views_of(name)
            if view.frame_index in sweep_ns
        ]
        if not lag_s:
            return "fail", f"no image of {name} has a LiDAR sweep"
        lags.append(f"{name} {1000 * float(np.median(lag_s)):+.0f} ms")
        worst_s = max(worst_s, float(np.abs(lag_s).max()))
    detail = f"after the middle of the sweep: {', '.join(lags)}"
    return ("ok" if worst_s <= MAX_CAMERA_LAG_S else "fail"), detail


def check_camera_rig(scene: DrivingScene) -> tuple[Verdict, str]:
    """Whether every camera stays where it is on the car."""
    worst_m, worst_rad, worst_name = 0.0, 0.0, ""
    first_ns, last_ns = (int(scene.frame_timestamps_ns[row]) for row in (0, -1))
    for name in scene.camera_names:
        ego_from_camera = torch.stack(
            [
                invert_rigid(
                    interpolate_rigid_track(
                        scene.frame_timestamps_ns, scene.world_from_ego, view.timestamp_ns
                    )
                )
                @ view.camera.world_from_camera
                for view in scene.views_of(name)
                if first_ns <= view.timestamp_ns <= last_ns
            ]
            or [torch.eye(4, dtype=torch.float64)]
        )
        middle = ego_from_camera[len(ego_from_camera) // 2]
        spread_m = float((ego_from_camera[:, :3, 3] - middle[:3, 3]).norm(dim=1).max())
        spread_rad = float(_turn_rad(ego_from_camera, middle.expand_as(ego_from_camera)).max())
        if spread_m >= worst_m:
            worst_m, worst_rad, worst_name = spread_m, spread_rad, name
    detail = f"at most {worst_m:.3f} m and {worst_rad:.4f} rad off its place ({worst_name})"
    return ("ok" if worst_m <= MAX_RIG_SPREAD_M else "warn"), detail


def _turn_rad(first: Tensor, second: Tensor) -> Tensor:
    """Angle between the rotations of two stacks of poses."""
    cosine = quaternion_from_rotation(first[:, :3, :3].transpose(-1, -2) @ second[:, :3, :3])[:, 0]
    return 2 * torch.arccos(cosine.clamp(max=1.0))


def _drives_across(world_from_ego: Float[Tensor, "frames 4 4"]) -> bool:
    """Whether a car drives beside its own x axis, neither forward nor back."""
    step_m = world_from_ego[:, :3, 3].diff(dim=0)
    length_m = step_m.norm(dim=1)
    along_m = (step_m * world_from_ego[:-1, :3, 0]).sum(dim=1).abs()
    is_step = length_m > _MIN_STEP_M
    return bool(along_m[is_step].sum() < 0.5 * length_m[is_step].sum())


def _frame_after(scene: DrivingScene, step: int) -> int:
    return scene.frame_indices[min(step + 1, len(scene.frame_indices) - 1)]


_BY_POINTS = {
    "camera sync",
    "ground",
    "LiDAR origins",
    "sweeps agree",
    "clear air",
    "points in images",
    "camera calibration",
    "cameras in their place",
    "boxes hold points",
    "boxes around points",
    "unboxed traffic",
}
