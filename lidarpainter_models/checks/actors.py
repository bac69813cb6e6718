"""Checks of the boxes of a scene: do they hold points, point ahead, and stand for one actor each?

Wrong conventions (length along y, yaw from another axis, boxes at another moment) show here first.
"""

from collections.abc import Sequence
from functools import cache
from itertools import pairwise

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial import cKDTree
from torch import Tensor

from lidarpainter_models.checks.sweeps import LidarReach, could_any_hit, reaches_of
from lidarpainter_models.checks.verdicts import Verdict
from lidarpainter_models.geometry.boxes import is_inside_box
from lidarpainter_models.geometry.transforms import invert_rigid, transform_points
from lidarpainter_models.scenes.driving_scene import DrivingScene
from lidarpainter_models.scenes.tracks import ActorTrack

NEAR_M = 40.0
"""Boxes nearer than this should hold points."""
MIN_HELD_SHARE = 0.7
MIN_AHEAD_SHARE = 0.8
_MIN_STEP_M, _MAX_STEP_NS = 1.0, 1_000_000_000
"""From one box of a track to a later one; a longer gap tells nothing of the way between."""
_MIN_STEPS = 2
"""Between boxes; a single one may be one wrong number."""
_FACE_M, _FLOOR_M = 0.05, 0.1
"""Points so near to a face of a box may be in or out; those so low over its bottom may be road."""
_SAME_PLACE_M, _MOST_CHANGED, _MIN_CHANGED = 4.0, 0.3, 10
"""How far an actor gets in a frame at the most; the share of actors that get a new id meanwhile,
and their number, beyond which ids are said not to last."""
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
        cosines = _cosines_ahead(track) if track.is_moving else np.zeros(0)
        if len(cosines):
            travelling += 1
            steps += len(track.timestamps_ns) - 1
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


def _cosines_ahead(track: ActorTrack) -> np.ndarray:
    """Of the angles between the x axis of boxes and the way to the next box some way on."""
    centres_m, axes = track.world_from_box[:, :3, 3].numpy(), track.world_from_box[:, :3, 0].numpy()
    times_ns, cosines = track.timestamps_ns.numpy(), []
    for first in range(len(times_ns)):
        is_near = times_ns[first + 1 :] - times_ns[first] <= _MAX_STEP_NS
        way_m = centres_m[first + 1 :][is_near] - centres_m[first]
        length_m = np.linalg.norm(way_m, axis=1)
        if len(length_m) and length_m.max() >= _MIN_STEP_M:
            later = int(np.argmax(length_m >= _MIN_STEP_M))
            ends = axes[[first, first + 1 + later]]
            cosines += (ends @ way_m[later] / length_m[later]).tolist()
    return np.array(cosines)


def check_own_boxes(scene: DrivingScene) -> tuple[Verdict, str]:
    """Whether boxes hold the recording car itself."""
    if not scene.own_boxes:
        return "ok", "no box holds the recording car"
    named = ", ".join(str(own) for own in scene.own_boxes[:3])
    return "warn", f"boxes that hold the recording car itself are ignored: {named}"


def check_lasting_ids(scene: DrivingScene) -> tuple[Verdict, str]:
    """Whether actors keep their id from frame to frame."""
    by_frame: dict[int, dict[str, tuple[np.ndarray, str]]] = {}
    for track in scene.tracks:
        for frame, centre_m in zip(
            track.frame_indices.tolist(), track.world_from_box[:, :3, 3].numpy(), strict=True
        ):
            by_frame.setdefault(frame, {})[track.actor_id] = (centre_m, track.category)
    kept = changed = 0
    for frame, following in pairwise(scene.frame_indices):
        before, after = by_frame.get(frame, {}), by_frame.get(following, {})
        kept += len(before.keys() & after.keys())
        new = [where for actor_id, where in after.items() if actor_id not in before]
        for centre_m, category in (w for actor_id, w in before.items() if actor_id not in after):
            changed += any(
                category == other and np.linalg.norm(centre_m - new_m) < _SAME_PLACE_M
                for new_m, other in new
            )
    detail = f"{changed} of {kept + changed} boxes have another id in the next frame"
    if changed >= _MIN_CHANGED and changed > _MOST_CHANGED * (kept + changed):
        return "warn", (
            f"{detail}: ids must last, else no actor is seen to move and what drives is smeared "
            "into the street"
        )
    return "ok", detail if kept + changed else "no actor is in two frames"


def check_duplicate_tracks(scene: DrivingScene) -> tuple[Verdict, str]:
    """Whether two tracks stand for the same actor."""
    pairs = [(scene.tracks[i], scene.tracks[j]) for i, j in _pairs_that_meet(scene.tracks)]
    twins = [f"{a.actor_id} = {b.actor_id}" for a, b in pairs if _are_twins(a, b)]
    if twins:
        return "warn", f"{len(twins)} pairs stand in the same place: {', '.join(twins[:3])}"
    return "ok", f"{len(scene.tracks)} tracks, each in a place of its own"


def _near_moving_boxes(scene: DrivingScene) -> list[tuple[bool, bool]]:
    """Of each box of a moving actor near the car: could a LiDAR hit it, does it hold points."""

    @cache
    def swept(frame_index: int) -> tuple[list[LidarReach], Tensor]:
        return reaches_of(scene, frame_index), _points(scene, frame_index)

    found = []
    for track in scene.tracks:
        if not track.is_moving:
            continue
        for row, frame_index in enumerate(track.frame_indices.tolist()):
            world_from_box = track.world_from_box[row]
            ego_m = scene.world_from_ego[scene.frame_position(frame_index), :3, 3]
            if (world_from_box[:3, 3] - ego_m).norm() < NEAR_M:
                reaches, points_m = swept(frame_index)
                could_be_hit = could_any_hit(reaches, world_from_box, track.size_m)
                holds = bool(track.num_points[row] > 0) or _counted(
                    points_m, world_from_box, track.size_m, _FACE_M, _FLOOR_M
                )
                found.append((could_be_hit, bool(holds)))
    return found


def _points(scene: DrivingScene, frame_index: int) -> Float[Tensor, "points 3"]:
    sweeps = scene.sweeps_of(frame_index)
    return torch.cat([torch.zeros(0, 3), *(scene.read_column(sweep, "xyz_m") for sweep in sweeps)])


def _counted(
    xyz_m: Float[Tensor, "points 3"],
    world_from_box: Float[Tensor, "4 4"],
    size_m: Float[Tensor, "3"],
    margin_m: float,
    floor_m: float | None = None,
) -> int:
    """How many points a box holds; of one grown, those higher than `floor_m` over its bottom."""
    near = (xyz_m - world_from_box[:3, 3].to(xyz_m)).norm(dim=1) < size_m.norm()
    inside = xyz_m[near][is_inside_box(xyz_m[near], world_from_box, size_m, margin_m=margin_m)]
    if floor_m is None or not len(inside):
        return len(inside)
    height_m = transform_points(invert_rigid(world_from_box).to(inside), inside)[:, 2]
    return int((height_m > floor_m - size_m[2] / 2).sum())


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
            stated, box = int(track.num_points[row]), (track.world_from_box[row], track.size_m)
            fewest, most = (_counted(xyz_m, *box, margin_m) for margin_m in (-_FACE_M, _FACE_M))
            if not fewest - max(20, stated // 2) <= stated <= most + max(20, stated // 2):
                return (
                    f"{track.actor_id} states {stated} points in frame {frame_index}, has "
                    f"{fewest} to {most}"
                )
    return ""
