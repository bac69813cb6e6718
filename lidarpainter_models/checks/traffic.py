"""Whether anything drives that no box tells of: places that are full in one sweep, empty in others.

What drives leaves its place. From where the LiDAR is half a second before and after, beams pass
through where the thing stood and end behind it. Places over the road that both other sweeps see
empty are put together to things by cells of the ground.
World: z up; lengths are metres.
"""

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.ndimage import minimum_filter
from torch import Tensor

from lidarpainter_models.checks.seen_space import SeenSpace
from lidarpainter_models.checks.verdicts import Verdict
from lidarpainter_models.geometry.boxes import is_inside_box
from lidarpainter_models.scenes.driving_scene import DrivingScene
from lidarpainter_models.scenes.records import Sweep
from lidarpainter_models.scenes.tracks import ActorTrack

MOST_UNLABELLED = 0.5
"""Things a sweep that move without a box, beyond which it is said."""
MOST_DRIFT_M = 3.0
"""What goes farther from its first box to its last does not stand."""
_REACH_M = 35.0
_APART_S = (0.4, 1.5)
_NUM_SWEEPS = 8
_CELL_M = 0.4
_OVER_ROAD_M = (0.3, 3.0)
_BEYOND_M, _BEYOND_SHARE = 1.0, 0.05
"""A beam that ends so much farther has passed through a place."""
_WIDE_M = 3.0  # a car hides the road under it
_LEAST_EMPTY, _LEAST_IN_CELL = 0.8, 3
_LEAST_CELLS, _LEAST_POINTS = 5, 40
"""Of a thing; a part of a car is as large."""
_BOX_MARGIN_M = 0.6


def check_traffic(scene: DrivingScene) -> tuple[Verdict, str]:
    """Whether moving things are boxed, and said to move."""
    if drives := [track.actor_id for track in scene.tracks if _drives_though_standing(track)]:
        return "warn", (
            f"{len(drives)} actors said to stand go farther than {MOST_DRIFT_M:.0f} m "
            f"({drives[0]}, ...): a fit holds them for street; say that they move"
        )
    triples = _triples(scene)
    if not triples:
        return "ok", "not checked: too few sweeps half a second apart"
    counts = [_num_moved(scene, *triple) for triple in triples]
    mean = float(np.mean(counts))
    detail = f"{mean:.1f} things a sweep move without a box (within {_REACH_M:.0f} m)"
    if mean > MOST_UNLABELLED:
        return "warn", (
            f"{detail}: a fit holds what has no box for street, so they are smeared along their "
            "way and hide what is behind; add boxes with ids that last"
        )
    if not scene.tracks:
        detail += (
            "; nothing has a box, and what drives less than its own length in "
            f"{_APART_S[0]:.1f} s was not checked"
        )
    return "ok", detail


def _drives_though_standing(track: ActorTrack) -> bool:
    way_m = track.world_from_box[-1, :3, 3] - track.world_from_box[0, :3, 3]
    return not track.is_moving and float(way_m.norm()) > MOST_DRIFT_M


def _triples(scene: DrivingScene) -> list[tuple[Sweep, Sweep, Sweep]]:
    """Sweeps of the LiDAR of most points, evenly over the log, each with one before and after."""
    if not scene.lidar_names:
        return []
    num_points = {
        name: sum(sweep.num_points for sweep in scene.sweeps if sweep.lidar_name == name)
        for name in scene.lidar_names
    }
    name = max(scene.lidar_names, key=lambda name: num_points[name])
    sweeps = [sweep for sweep in scene.sweeps if sweep.lidar_name == name]
    times_s = np.array([sweep.timestamp_ns for sweep in sweeps]) / 1e9
    found = []
    for place, now_s in enumerate(times_s):
        after = int(np.searchsorted(times_s, now_s + _APART_S[0]))
        before = int(np.searchsorted(times_s, now_s - _APART_S[0], side="right")) - 1
        if before < 0 or after >= len(sweeps):
            continue
        if max(now_s - times_s[before], times_s[after] - now_s) <= _APART_S[1]:
            found.append((sweeps[before], sweeps[place], sweeps[after]))
    return found[:: max(1, -(-len(found) // _NUM_SWEEPS))]


def _num_moved(scene: DrivingScene, before: Sweep, now: Sweep, after: Sweep) -> int:
    """How many things of a sweep have left their place, and are in no box."""
    xyz_m = scene.read_column(now, "xyz_m")
    over_m = (xyz_m - now.world_from_lidar[:3, 3].to(xyz_m)).numpy()
    is_near = np.abs(over_m[:, :2]).max(axis=1) < _REACH_M
    xyz_m, over_m = xyz_m[torch.from_numpy(is_near)], over_m[is_near]
    cell = np.floor((over_m[:, :2] + _REACH_M) / _CELL_M).astype(int)
    size = int(np.ceil(2 * _REACH_M / _CELL_M)) + 1
    road_m = np.full((size, size), np.inf, np.float32)
    np.minimum.at(road_m, (cell[:, 0], cell[:, 1]), over_m[:, 2])
    wide = round(_WIDE_M / _CELL_M)
    height_m = over_m[:, 2] - minimum_filter(road_m, wide)[cell[:, 0], cell[:, 1]]
    is_thing = (height_m > _OVER_ROAD_M[0]) & (height_m < _OVER_ROAD_M[1])
    things_m, cell = xyz_m[torch.from_numpy(is_thing)], cell[is_thing]
    is_empty = _is_passed(scene, before, things_m) & _is_passed(scene, after, things_m)
    for track in scene.tracks:
        if track.is_present(now.timestamp_ns):
            box = track.pose_at(now.timestamp_ns), track.size_m
            is_empty &= ~is_inside_box(things_m, *box, margin_m=_BOX_MARGIN_M).numpy()
    filled, empty = np.zeros((size, size), int), np.zeros((size, size), int)
    np.add.at(filled, (cell[:, 0], cell[:, 1]), 1)
    np.add.at(empty, (cell[:, 0], cell[:, 1]), is_empty)
    has_left = (empty >= _LEAST_IN_CELL) & (empty >= _LEAST_EMPTY * filled)
    count, things = cv2.connectedComponents(has_left.astype(np.uint8))
    num_cells = np.bincount(things.ravel(), minlength=count)[1:]
    num_points = np.bincount(things.ravel(), empty.ravel(), minlength=count)[1:]
    return int(((num_cells >= _LEAST_CELLS) & (num_points >= _LEAST_POINTS)).sum())


def _is_passed(
    scene: DrivingScene, sweep: Sweep, points_m: Float[Tensor, "points 3"]
) -> Bool[np.ndarray, " points"]:
    """Which places the beams of a sweep have passed through."""
    seen_m = scene.read_column(sweep, "xyz_m").double().numpy()
    space = SeenSpace(seen_m, sweep.world_from_lidar[:3, 3].numpy())
    places_m = points_m.double().numpy()
    return space.passed(places_m, beyond_m=_BEYOND_M, beyond_share=_BEYOND_SHARE)
