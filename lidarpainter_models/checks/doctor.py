"""Tell whether a scene can be trusted, and where it cannot.

Each check looks at one thing that a wrong convention, a wrong clock or a damaged file would break,
and says what it measured. `fail` means that a reconstruction would be wrong, `warn` that a part of
it will be poor.
"""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

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
from lidarpainter_models.checks.calibration import Agrees, check_calibration, check_image_places
from lidarpainter_models.checks.depth_edges import SceneEdges
from lidarpainter_models.checks.pictures import check_pictures
from lidarpainter_models.checks.sweeps import (
    check_clear_air,
    check_coverage,
    check_ground,
    check_origins,
    check_sweeps_agree,
)
from lidarpainter_models.checks.traffic import check_traffic
from lidarpainter_models.checks.verdicts import Verdict, sampled_positions
from lidarpainter_models.errors import SceneError
from lidarpainter_models.geometry.transforms import (
    invert_rigid,
    is_rigid,
    transform_points,
    turn_rad,
)
from lidarpainter_models.scenes.driving_scene import DrivingScene, driven_road
from lidarpainter_models.scenes.tracks import ActorTrack

MAX_OFF_M = 0.25
"""Beyond which boxes are said to stand wrong, in the median: sound ones are found within 0.1."""
LEAST_BOXES = 10
NEAR_M = 30.0
_NUM_FRAMES = 6
_LEAST_LENGTH_M = 3.0  # a car: what is smaller has no sides
_LEAST_POINTS, _MOST_POINTS = 60, 1000
_REACH_M = 1.0
_STEPS_M = np.arange(-_REACH_M, _REACH_M + 0.01, 0.1)
_INSIDE_M, _BEYOND_M = 0.3, 0.1  # of a side, points are along it: boxes hold mirrors and wheels
_OVER_ROAD_M, _SILL_M = 0.4, 1.0  # over the lower side: windows lean inwards
_OUTSIDE_COSTS, _WAY_COSTS = 2.0, 0.05  # the latter a metre


def check_box_places(scene: DrivingScene) -> tuple[Verdict, str]:
    """Whether the boxes of standing cars lie around their points."""
    swept = scene.swept_frames
    standing = [
        track
        for track in scene.tracks
        if not track.is_moving and track.size_m[0] >= _LEAST_LENGTH_M
    ]
    off_m = []
    for frame_index in (swept[place] for place in sampled_positions(len(swept), _NUM_FRAMES)):
        xyz_m = scene.read_positions(frame_index).double()
        for track in standing:
            row = (track.frame_indices == frame_index).nonzero()[:, 0]
            if len(row) and (found := _off_m(scene, track, int(row[0]), xyz_m)) is not None:
                off_m.append(found)
    if len(off_m) < LEAST_BOXES:
        return "ok", f"only {len(off_m)} boxes of standing cars within {NEAR_M:.0f} m hold enough"
    middle_m = float(np.median(off_m))
    detail = f"{len(off_m)} boxes of standing cars lie {middle_m:.2f} m off their points (median)"
    return ("ok" if middle_m <= MAX_OFF_M else "warn"), detail


def _off_m(
    scene: DrivingScene, track: ActorTrack, row: int, xyz_m: Float[Tensor, "points 3"]
) -> float | None:
    """How far a box must go to lie around the points there; None where there are too few."""
    world_from_box = track.world_from_box[row].double()
    ego_m = scene.world_from_ego[scene.frame_position(int(track.frame_indices[row])), :3, 3]
    if (world_from_box[:3, 3] - ego_m).norm() > NEAR_M:
        return None
    half_m = track.size_m.double() / 2
    around = (xyz_m - world_from_box[:3, 3]).abs().amax(dim=1) < float(half_m[0]) + 2 * _REACH_M
    own_m = transform_points(invert_rigid(world_from_box), xyz_m[around])
    height_m = own_m[:, 2] + half_m[2]
    is_body = (height_m > _OVER_ROAD_M) & (height_m < _SILL_M)
    is_body &= (own_m[:, :2].abs() < half_m[:2] + _REACH_M).all(dim=1)
    body_m = own_m[is_body, :2].numpy()
    if len(body_m) < _LEAST_POINTS:
        return None
    return _best_shift_m(body_m[:: -(-len(body_m) // _MOST_POINTS)], half_m[:2].numpy())


def _best_shift_m(body_m: Float[np.ndarray, "points 2"], half_m: Float[np.ndarray, "2"]) -> float:
    """Length of the shift that puts most points along the sides and fewest outside."""
    x, y = np.meshgrid(_STEPS_M, _STEPS_M, indexing="ij")
    shifts_m = np.stack([x.ravel(), y.ravel()], axis=1)
    beyond_m = (np.abs(body_m[None] - shifts_m[:, None]) - half_m).max(axis=2)
    along = ((beyond_m >= -_INSIDE_M) & (beyond_m <= _BEYOND_M)).mean(axis=1)
    outside = (beyond_m > _BEYOND_M).mean(axis=1)
    score = along - _OUTSIDE_COSTS * outside - _WAY_COSTS * np.linalg.norm(shifts_m, axis=1)
    return float(np.linalg.norm(shifts_m[score.argmax()]))


MAX_SPEED_MPS = 60.0
MAX_SPEED_CHANGE_MPS2 = 15.0
MAX_TURN_RADPS = 2.0
MAX_CAMERA_LAG_S = 0.15
"""A camera takes its image while the LiDAR turns; farther apart is another frame's image."""
MAX_RIG_SPREAD_M = 0.15
_NON_COMMERCIAL = ("non-commercial", "noncommercial", "-nc-", " nc ", "-nc ")
_NEED_NO_POSES = ("stored content", "licence", "ego poses", "timestamps", "camera sync", "images")
"""Checks of a scene of which nobody knows where the car drove."""
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
    has_lidar = bool(scene.lidar_names)
    checks: tuple[tuple[str, Callable[[DrivingScene], tuple[Verdict, str]], bool], ...] = (
        ("stored content", check_content, True),
        ("licence", check_licence, True),
        ("ego poses", check_ego_poses if scene.has_poses else _lacks_poses, True),
        ("timestamps", check_timestamps, True),
        ("camera sync", check_camera_sync, has_lidar),
        ("camera rig", check_camera_rig, True),
        ("images", check_pictures, True),
        ("ground", check_ground, has_lidar),
        ("LiDAR origins", check_origins, has_lidar),
        ("sweeps agree", check_sweeps_agree, has_lidar),
        ("clear air", check_clear_air, has_lidar),
        ("points in images", check_coverage, has_lidar),
        ("camera calibration", lambda _: check_calibration(edges, agrees), has_lidar),
        ("cameras in their place", lambda _: check_image_places(edges), has_lidar),
        ("boxes hold points", check_box_points, has_lidar),
        ("boxes around points", check_box_places, has_lidar),
        ("boxes point ahead", check_box_axes, True),
        ("duplicate tracks", check_duplicate_tracks, True),
        ("lasting ids", check_lasting_ids, True),
        ("own boxes", check_own_boxes, True),
        ("unboxed traffic", check_traffic, has_lidar),
    )
    found = [
        _run(name, check, scene, looking_at)
        for name, check, is_due in checks
        if is_due and (scene.has_poses or name in _NEED_NO_POSES)
    ]
    if not has_lidar:
        without = "none: a fit takes its points from images, and what needs points is not checked"
        found.append(Check(name="LiDAR", verdict="warn", detail=without))
    return found


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
    turn = turn_rad(scene.world_from_ego[:-1], scene.world_from_ego[1:]) / step_s
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


def _lacks_poses(scene: DrivingScene) -> tuple[Verdict, str]:
    command = f"lidarpainter localise {scene.dataset}/{scene.sequence}"
    return "fail", f"none were recorded: `{command}` finds them; what needs them is not checked"


def check_timestamps(scene: DrivingScene) -> tuple[Verdict, str]:
    """Whether time runs forward, without gaps."""
    steps_s = scene.frame_timestamps_ns.diff().double() / 1e9
    for name in scene.camera_names:
        for before, view in pairwise(scene.views_of(name)):
            if view.timestamp_ns <= before.timestamp_ns:
                early_ms = (before.timestamp_ns - view.timestamp_ns) / 1e6
                how_old = f"{early_ms:.0f} ms older than" if early_ms else "as old as"
                return "fail", (
                    f"the times of {name} do not ascend: frame {view.frame_index} has an image "
                    f"{how_old} frame {before.frame_index}'s: give each its own "
                    "time, and leave an image out that was there before"
                )
    if len(steps_s) == 0:
        return "warn", "a single frame"
    middle_s = float(steps_s.median())
    gaps = int((steps_s > 1.5 * middle_s).sum())
    detail = f"{len(scene.frame_indices)} frames, every {1000 * middle_s:.0f} ms"
    if gaps:
        longest = int(steps_s.argmax())
        after = f"{steps_s[longest]:.1f} s before frame {_frame_after(scene, longest)}"
        return "warn", f"{detail}, {gaps} gaps, the longest of {after}"
    return "ok", detail


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
    worst_m, worst_rad, worst_name = 0.0, 0.0, scene.camera_names[-1]
    first_ns, last_ns = (int(scene.frame_timestamps_ns[row]) for row in (0, -1))
    for name in scene.camera_names:
        views = [v for v in scene.views_of(name) if first_ns <= v.timestamp_ns <= last_ns]
        if not views:
            continue
        ego = driven_road(scene).at(torch.tensor([view.timestamp_ns for view in views]))
        world_from_camera = torch.stack([view.camera.world_from_camera for view in views])
        ego_from_camera = invert_rigid(ego.world_from_body) @ world_from_camera
        middle = ego_from_camera[len(ego_from_camera) // 2]
        spread_m = float((ego_from_camera[:, :3, 3] - middle[:3, 3]).norm(dim=1).max())
        spread_rad = float(turn_rad(ego_from_camera, middle.expand_as(ego_from_camera)).max())
        if spread_m >= worst_m:
            worst_m, worst_rad, worst_name = spread_m, spread_rad, name
    detail = f"at most {worst_m:.3f} m and {worst_rad:.4f} rad off its place ({worst_name})"
    return ("ok" if worst_m <= MAX_RIG_SPREAD_M else "warn"), detail


def _drives_across(world_from_ego: Float[Tensor, "frames 4 4"]) -> bool:
    """Whether a car drives beside its own x axis, neither forward nor back."""
    step_m = world_from_ego[:, :3, 3].diff(dim=0)
    length_m = step_m.norm(dim=1)
    along_m = (step_m * world_from_ego[:-1, :3, 0]).sum(dim=1).abs()
    is_step = length_m > _MIN_STEP_M
    return bool(along_m[is_step].sum() < 0.5 * length_m[is_step].sum())


def _frame_after(scene: DrivingScene, step: int) -> int:
    return scene.frame_indices[min(step + 1, len(scene.frame_indices) - 1)]
