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
)
from lidarpainter_models.checks.box_places import check_box_places
from lidarpainter_models.checks.calibration import check_calibration
from lidarpainter_models.checks.clear_air import check_clear_air
from lidarpainter_models.checks.depth_edges import SceneEdges
from lidarpainter_models.checks.lidar_reach import reaches_of
from lidarpainter_models.checks.overlay import draw_overlay
from lidarpainter_models.checks.swapped_images import check_swapped_images
from lidarpainter_models.checks.sweep_agreement import NEIGHBOURHOOD_M, points_near, sweep_offset_m
from lidarpainter_models.errors import SceneError
from lidarpainter_models.geometry.transforms import (
    interpolate_rigid_track,
    invert_rigid,
    is_rigid,
    quaternion_from_rotation,
)
from lidarpainter_models.scenes.driving_scene import DrivingScene
from lidarpainter_models.scenes.records import RecordedView

__all__ = ["Check", "check_scene", "draw_overlay"]

Verdict = Literal["ok", "warn", "fail"]

MAX_SPEED_MPS = 60.0
MAX_SPEED_CHANGE_MPS2 = 15.0
MAX_TURN_RADPS = 2.0
MAX_CAMERA_LAG_S = 0.15
"""A camera takes its image while the LiDAR turns; farther apart is another frame's image."""
MAX_RIG_SPREAD_M = 0.15
MIN_COVERAGE = 0.15
MOST_TILTED = 0.7
"""Sine of the elevation beyond which no camera of a car looks."""
MAX_SWEEP_OFFSET_M = 0.15
"""By which a sweep must be moved onto the next."""
MAX_GROUND_SLOPE_RAD = 0.15
_NON_COMMERCIAL = ("non-commercial", "noncommercial", "-nc-", " nc ", "-nc ")
_COVERAGE_CELLS = (9, 16)
_MIN_STEP_M = 0.2
"""From frame to frame; the poses of a car that stands jitter by less."""
_GROUND_CELL_M = 2.0
_GROUND_THICKNESS_M = 0.3
_NUM_GROUND_TRIES = 1000
_NUM_SAMPLED_FRAMES = 4
_POINT_STRIDE = 3
"""Every third point tells as well which cells of an image are covered."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Check:
    """One finding about a scene."""

    name: str
    verdict: Verdict
    detail: str


def check_scene(scene: DrivingScene) -> list[Check]:
    """Run every check; the order is that in which a reader would debug a new dataset."""
    edges = SceneEdges(scene)
    checks: tuple[tuple[str, Callable[[DrivingScene], tuple[Verdict, str]]], ...] = (
        ("stored content", check_content),
        ("licence", check_licence),
        ("ego poses", check_ego_poses),
        ("timestamps", check_timestamps),
        ("camera sync", check_camera_sync),
        ("camera rig", check_camera_rig),
        ("ground", check_ground),
        ("sweeps agree", check_sweeps_agree),
        ("clear air", check_clear_air),
        ("points in images", check_coverage),
        ("camera calibration", lambda _: check_calibration(edges)),
        ("cameras in their place", lambda _: check_swapped_images(edges)),
        ("boxes hold points", check_box_points),
        ("boxes around points", check_box_places),
        ("boxes point ahead", check_box_axes),
        ("duplicate tracks", check_duplicate_tracks),
    )
    if scene.lidar_names:
        return [_run(name, check, scene) for name, check in checks]
    without = "none: a fit takes its points from images, and what needs points is not checked"
    return [
        *(_run(name, check, scene) for name, check in checks if name not in _BY_POINTS),
        Check(name="LiDAR", verdict="warn", detail=without),
    ]


def _run(
    name: str, check: Callable[[DrivingScene], tuple[Verdict, str]], scene: DrivingScene
) -> Check:
    try:
        verdict, detail = check(scene)
    except SceneError as error:  # a damaged part fails the checks that need it, not the others
        verdict, detail = "fail", str(error)
    return Check(name=name, verdict=verdict, detail=detail)


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


def check_ground(scene: DrivingScene) -> tuple[Verdict, str]:
    """Whether up is up: the lowest points around the car form a level plane below it."""
    position = scene.world_from_ego[0, :3, 3]
    xyz_m = scene.read_positions(scene.sweeps[0].frame_index).double() - position
    near = xyz_m[(xyz_m[:, :2].norm(dim=1) < NEIGHBOURHOOD_M) & (xyz_m[:, 2].abs() < 4)].numpy()
    if len(near) < 100:
        return "warn", f"only {len(near)} points within {NEIGHBOURHOOD_M:.0f} m of the car"
    slope_rad, height_m = _ground_plane(_lowest_in_cells(near))
    detail = f"{height_m:+.2f} m from the ego origin, slope {np.degrees(slope_rad):.1f} degrees"
    if slope_rad > MAX_GROUND_SLOPE_RAD:
        return "fail", f"{detail}: is z up?"
    return "ok", detail


def check_sweeps_agree(scene: DrivingScene) -> tuple[Verdict, str]:
    """Whether consecutive sweeps lie on each other in the world: poses and motion compensation."""
    frames = sorted({sweep.frame_index for sweep in scene.sweeps})
    if len(frames) < 2:
        return "warn", "a single sweep: nothing to compare"
    offsets_m = []
    for position in sampled_positions(len(frames) - 1):
        first, second = frames[position : position + 2]
        offset_m = sweep_offset_m(_points_near_ego(scene, first), _points_near_ego(scene, second))
        if offset_m is not None:
            offsets_m.append(offset_m)
    if not offsets_m:
        return "warn", f"no surface within {NEIGHBOURHOOD_M:.0f} m of the car is in two sweeps"
    detail = f"surfaces of two sweeps near the car lie up to {max(offsets_m):.3f} m apart"
    return ("ok" if max(offsets_m) <= MAX_SWEEP_OFFSET_M else "fail"), detail


def check_coverage(scene: DrivingScene) -> tuple[Verdict, str]:
    """How much of each camera's image the LiDAR reaches, in cells of a 16 x 9 grid."""
    covered: dict[str, list[float]] = {name: [] for name in scene.camera_names}
    frames = sorted({sweep.frame_index for sweep in scene.sweeps})
    for position in sampled_positions(len(frames)):
        xyz_m = scene.read_positions(frames[position])[::_POINT_STRIDE]
        for view in scene.views:
            if view.frame_index == frames[position]:
                covered[view.camera_name].append(_covered_share(view, xyz_m))
    shares = {name: float(np.mean(found or [0.0])) for name, found in covered.items()}
    detail = ", ".join(f"{name} {share:.0%}" for name, share in shares.items())
    unseeing = [name for name, share in shares.items() if share == 0]
    if any(_looks_where_a_lidar_does(scene, name) for name in unseeing):
        return "fail", f"{detail}: a camera sees no point"
    if unseeing:
        return "warn", f"{detail}: {', '.join(unseeing)} looks where no LiDAR does"
    return ("ok" if min(shares.values()) >= MIN_COVERAGE else "warn"), detail


def _looks_where_a_lidar_does(scene: DrivingScene, camera_name: str) -> bool:
    """Whether points are due in a camera's images: it looks up, down, or into a LiDAR's sector."""
    view = scene.views_of(camera_name)[0]
    axis = view.camera.world_from_camera[:3, 2]
    if abs(float(axis[2])) > MOST_TILTED:
        return True
    return any(reach.covers(axis) for reach in reaches_of(scene, view.frame_index))


def _covered_share(view: RecordedView, xyz_m: Float[Tensor, "points 3"]) -> float:
    """Share of the cells of an image that a point falls into."""
    camera, (num_rows, num_columns) = view.camera, _COVERAGE_CELLS
    pixels_uv, depth_m = camera.project(xyz_m)
    seen = pixels_uv[camera.contains(pixels_uv, depth_m)]
    rows = (seen[:, 1] / camera.height_px * num_rows).long()
    columns = (seen[:, 0] / camera.width_px * num_columns).long()
    return len(torch.unique(rows * num_columns + columns)) / (num_rows * num_columns)


def _points_near_ego(scene: DrivingScene, frame_index: int) -> np.ndarray:
    centre_m = scene.world_from_ego[scene.frame_position(frame_index), :3, 3]
    return points_near(scene.read_positions(frame_index), centre_m)


def _lowest_in_cells(points_m: np.ndarray) -> np.ndarray:
    """The lowest point over every square cell of the ground."""
    cells = np.floor(points_m[:, :2] / _GROUND_CELL_M).astype(int)
    order = np.lexsort((points_m[:, 2], cells[:, 1], cells[:, 0]))
    first = np.ones(len(order), dtype=bool)
    first[1:] = (np.diff(cells[order], axis=0) != 0).any(axis=1)
    return points_m[order[first]]


def _ground_plane(points_m: np.ndarray) -> tuple[float, float]:
    """Slope (rad) of the plane that most points lie on, and its height below the origin (m)."""
    import open3d

    open3d.utility.random.seed(0)
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points_m))
    plane, _ = cloud.segment_plane(_GROUND_THICKNESS_M, 3, _NUM_GROUND_TRIES)
    slope_rad = np.arctan2(np.hypot(plane[0], plane[1]), abs(plane[2]))
    return float(slope_rad), float(-plane[3] / np.copysign(max(abs(plane[2]), 1e-9), plane[2]))


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


def sampled_positions(count: int) -> list[int]:
    """A few positions spread evenly over `count`."""
    return sorted({round(x) for x in np.linspace(0, count - 1, min(count, _NUM_SAMPLED_FRAMES))})


_BY_POINTS = {
    "camera sync",
    "ground",
    "sweeps agree",
    "clear air",
    "points in images",
    "camera calibration",
    "cameras in their place",
    "boxes hold points",
    "boxes around points",
}
