"""Checks of the boxes of a scene: do they hold points, point ahead, and stand for one actor each?

Wrong conventions (length along y, yaw from another axis, boxes at another moment) show here first.
"""

from collections.abc import Sequence
from typing import Literal

import numpy as np
import torch
from scipy.spatial import cKDTree

from lidarpainter_models.checks.lidar_reach import LidarReach, could_any_hit, reaches_of
from lidarpainter_models.geometry.boxes import is_inside_box
from lidarpainter_models.scenes.driving_scene import DrivingScene
from lidarpainter_models.scenes.tracks import ActorTrack

Verdict = Literal["ok", "warn", "fail"]

NEAR_M = 40.0
"""Boxes nearer than this should hold points."""
MIN_HELD_SHARE = 0.7
MIN_AHEAD_SHARE = 0.8
_MIN_TRAVEL_M = 1.0
_MIN_STEPS = 2
"""Between boxes; a single one may be one wrong number."""
_DUPLICATE_SHARE = 0.5
"""Two boxes closer than this share of the smaller one's width are the same place."""
_NUM_RECOUNTED = 20


def check_box_points(scene: DrivingScene) -> tuple[Verdict, str]:
    """Whether near moving boxes that a LiDAR could hit hold points, and as many as stated."""
    near = _near_moving_boxes(scene)
    if not near:
        return "ok", f"no moving box within {NEAR_M:.0f} m"
    held = [holds_points for could_be_hit, holds_points in near if could_be_hit]
    left_out = len(near) - len(held)
    where = "in the sector and range that a LiDAR covered"
    if not held:
        return "warn", f"none of {left_out} moving boxes within {NEAR_M:.0f} m lies {where}"
    detail = f"{sum(held)} of {len(held)} moving boxes within {NEAR_M:.0f} m hold points"
    if left_out:
        detail += f" ({left_out} more left out: not {where})"
    worst = _largest_miscount(scene)
    if worst:
        return "warn", f"{detail}; {worst}"
    if sum(held) < MIN_HELD_SHARE * len(held):
        return "fail" if sum(held) < len(held) / 2 else "warn", detail
    return "ok", detail


def check_box_axes(scene: DrivingScene) -> tuple[Verdict, str]:
    """Whether the x axis of moving boxes points where they go."""
    travelling = ahead = across = steps = 0
    for track in scene.tracks:
        path = track.world_from_box[-1, :3, 3] - track.world_from_box[0, :3, 3]
        if track.is_moving and path.norm() >= _MIN_TRAVEL_M:
            cosines = (track.world_from_box[:, :3, 0] @ path / path.norm()).numpy()
            travelling += 1
            steps += len(cosines) - 1
            ahead += bool(np.median(cosines) > 0.7)
            # a wrong convention turns nearly all boxes of an actor, a wrong number one of them
            across += bool(np.quantile(np.abs(cosines), MIN_AHEAD_SHARE) < 0.5)
    if not travelling:
        return "ok", "no actor travels far enough to tell"
    detail = f"{ahead} of {travelling} moving actors drive along their x axis"
    if across > travelling / 2:
        verdict: Verdict = "fail" if steps >= _MIN_STEPS else "warn"
        return verdict, f"{detail}, {across} across it: is the length along x?"
    return ("ok" if ahead >= MIN_AHEAD_SHARE * travelling else "warn"), detail


def check_duplicate_tracks(scene: DrivingScene) -> tuple[Verdict, str]:
    """Whether two tracks stand for the same actor."""
    pairs = [(scene.tracks[i], scene.tracks[j]) for i, j in _pairs_that_meet(scene.tracks)]
    twins = [f"{a.actor_id} = {b.actor_id}" for a, b in pairs if _are_twins(a, b)]
    if twins:
        return "warn", f"{len(twins)} pairs stand in the same place: {', '.join(twins[:3])}"
    return "ok", f"{len(scene.tracks)} tracks, each in a place of its own"


def _near_moving_boxes(scene: DrivingScene) -> list[tuple[bool, bool]]:
    """Of each box of a moving actor near the car: could a LiDAR hit it, does it hold points."""
    reaches: dict[int, list[LidarReach]] = {}
    found = []
    for track in scene.tracks:
        if not track.is_moving:
            continue
        for row, frame_index in enumerate(track.frame_indices.tolist()):
            world_from_box = track.world_from_box[row]
            ego_m = scene.world_from_ego[scene.frame_position(frame_index), :3, 3]
            if (world_from_box[:3, 3] - ego_m).norm() < NEAR_M:
                if frame_index not in reaches:
                    reaches[frame_index] = reaches_of(scene, frame_index)
                could_be_hit = could_any_hit(reaches[frame_index], world_from_box, track.size_m)
                found.append((could_be_hit, bool(track.num_points[row] > 0)))
    return found


def _pairs_that_meet(tracks: Sequence[ActorTrack]) -> list[tuple[int, int]]:
    """Positions of tracks that stand in the same place in some frame: twins do in half of them."""
    if len(tracks) < 2:
        return []
    frames = torch.cat([track.frame_indices for track in tracks]).numpy()
    numbers = np.repeat(np.arange(len(tracks)), [len(track.frame_indices) for track in tracks])
    centres_m = torch.cat([track.world_from_box[:, :3, 3] for track in tracks]).numpy()
    reaches_m = _DUPLICATE_SHARE * np.array([float(track.size_m[1]) for track in tracks])[numbers]
    pairs: set[tuple[int, int]] = set()
    for frame in np.unique(frames):
        rows = np.flatnonzero(frames == frame)
        tree = cKDTree(centres_m[rows])
        near = rows[tree.query_pairs(reaches_m[rows].max(), output_type="ndarray")]
        apart_m = np.linalg.norm(centres_m[near[:, 0]] - centres_m[near[:, 1]], axis=1)
        met = near[apart_m < reaches_m[near].min(axis=1)]
        pairs.update((i, j) for i, j in numbers[met].tolist())
    return sorted(pairs)


def _are_twins(first: ActorTrack, second: ActorTrack) -> bool:
    common, rows, others = np.intersect1d(
        first.frame_indices.numpy(), second.frame_indices.numpy(), return_indices=True
    )
    if len(common) < 2:
        return False
    apart = first.world_from_box[rows, :3, 3] - second.world_from_box[others, :3, 3]
    reach_m = _DUPLICATE_SHARE * float(torch.minimum(first.size_m[1], second.size_m[1]))
    return float(apart.norm(dim=1).median()) < reach_m


def _largest_miscount(scene: DrivingScene) -> str:
    """Recount the points of some well-filled boxes; names the worst if it is far off."""
    frame_index = scene.sweeps[len(scene.sweeps) // 2].frame_index
    xyz_m = scene.read_positions(frame_index)
    for track in scene.tracks[:_NUM_RECOUNTED]:
        rows = (track.frame_indices == frame_index).nonzero()[:, 0]
        for row in rows.tolist():
            stated = int(track.num_points[row])
            counted = int(is_inside_box(xyz_m, track.world_from_box[row], track.size_m).sum())
            if abs(stated - counted) > max(20, stated // 2):
                return (
                    f"{track.actor_id} states {stated} points in frame {frame_index}, has {counted}"
                )
    return ""
