"""LiDAR points of what moves, told by free space.

A place through which beams pass at another time was not taken by something that stayed. Each point
over the ground is asked of sweeps up to some seconds before and after. What stands at the edge of
something else is passed by chance, so a point counts as its neighbours do. What is left makes
clumps (DBSCAN, Ester et al., 1996). World: z up; metres.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64
from scipy.spatial import cKDTree

from lidarpainter_models.checks.seen_space import SeenSpace
from lidarpainter_models.errors import SceneError
from lidarpainter_models.kernels.side_by_side import side_by_side
from lidarpainter_models.lidar.ground_heights import CELL_M, GroundHeights
from lidarpainter_models.scenes.driving_scene import DrivingScene

RANGES_M = (2.5, 60.0)
OVER_GROUND_M = (0.25, 4.2)
"""Nothing on a road is higher."""
OTHER_TIMES_S = (-2.4, -1.2, -0.7, -0.4, 0.4, 0.7, 1.2, 2.4)
BEYOND_M, BEYOND_SHARE = 0.4, 0.02
"""A beam that ends so much farther has passed a place."""
AROUND_M, LEAST_PASSED = 0.45, 0.5
"""Neighbours of a point, and the share of them that must be passed."""
EPS_M, EPS_PER_RANGE, LEAST_IN_CLUMP = 0.65, 0.012, 6
"""How near points of a clump are, and how that grows with the range."""
_GROUND_SAMPLE = 400_000


@dataclass(frozen=True, kw_only=True, eq=False)
class Clump:
    """Points of one frame that moved together, or stood where nobody stays."""

    frame_index: int
    time_ns: int
    """Median over its points."""
    origin_m: Float[np.ndarray, "3"]
    """Where they were measured from."""
    points_m: Float[np.ndarray, "points 3"]
    """World."""
    ground_m: float
    """Height of the ground below them."""


def moving_clumps(scene: DrivingScene) -> dict[int, list[Clump]]:
    """What moves in each frame that has sweeps; of a frame without others about it nothing.

    Raises:
        SceneError: fewer than two frames have sweeps.
    """
    frames = scene.swept_frames
    if len(frames) < 2:
        raise SceneError(
            f"{scene.path}: {len(frames)} frames with LiDAR sweeps, expected two at least: nothing "
            "else tells who moves"
        )
    seen = list(side_by_side(lambda frame: _swept(scene, frame), frames))
    if not any(len(one.points_m) for one in seen):
        return {}
    ground = _Ground([one.points_m for one in seen])
    places = range(len(frames))
    clumps = side_by_side(lambda place: _clumps(seen, place, ground), places)
    return dict(zip(frames, clumps, strict=True))


@dataclass(frozen=True, kw_only=True, eq=False)
class _Swept:
    """The points of a frame in range, and what its densest LiDAR looked through."""

    frame_index: int
    points_m: Float[np.ndarray, "points 3"]
    times_ns: Int64[np.ndarray, " points"]
    origin_m: Float[np.ndarray, "3"]
    space: SeenSpace


def _swept(scene: DrivingScene, frame_index: int) -> _Swept:
    sweeps = scene.sweeps_of(frame_index)
    densest = max(sweeps, key=lambda sweep: sweep.num_points)
    origin_m = densest.world_from_lidar[:3, 3].numpy()
    points_m = scene.read_positions(frame_index).numpy().astype(np.float64)
    times_ns = torch.cat([scene.measured_ns(sweep) for sweep in sweeps]).numpy()
    range_m = np.linalg.norm(points_m - origin_m, axis=1)
    is_near = (range_m > RANGES_M[0]) & (range_m < RANGES_M[1])
    of_densest = scene.read_column(densest, "xyz_m").numpy().astype(np.float64)
    return _Swept(
        frame_index=frame_index,
        points_m=points_m[is_near],
        times_ns=times_ns[is_near],
        origin_m=origin_m,
        space=SeenSpace(of_densest, origin_m),
    )


class _Ground:
    """Height of the ground by square cells, filled in where things stand on it."""

    def __init__(self, parts_m: Sequence[Float[np.ndarray, "_ 3"]]) -> None:
        total = sum(map(len, parts_m))
        step = max(1, total // _GROUND_SAMPLE)
        sample = np.concatenate([part_m[::step] for part_m in parts_m])
        heights = GroundHeights(torch.from_numpy(sample))
        self._first = np.floor(sample[:, :2].min(axis=0) / CELL_M).astype(np.int64)
        last = np.floor(sample[:, :2].max(axis=0) / CELL_M).astype(np.int64)
        rows, columns = np.unique(self._cells(sample, last), axis=0).T
        self._height_m = np.full(last - self._first + 1, np.inf)
        centres = (np.stack([rows, columns], axis=1) + self._first + 0.5) * CELL_M
        self._height_m[rows, columns] = heights.around(torch.from_numpy(centres)).numpy()
        self._last = last

    def at(self, points_m: Float[np.ndarray, "points 3"]) -> Float[np.ndarray, " points"]:
        """Below each point; where nothing is known very high, so that nothing stands on it."""
        cells = self._cells(points_m, self._last)
        return self._height_m[cells[:, 0], cells[:, 1]]

    def _cells(self, points_m: np.ndarray, last: np.ndarray) -> np.ndarray:
        cells = np.floor(points_m[:, :2] / CELL_M).astype(np.int64)
        return np.clip(cells, self._first, last) - self._first


def _clumps(seen: Sequence[_Swept], place: int, ground: _Ground) -> list[Clump]:
    now = seen[place]
    height_m = now.points_m[:, 2] - ground.at(now.points_m)
    rows = np.flatnonzero((height_m > OVER_GROUND_M[0]) & (height_m < OVER_GROUND_M[1]))
    things_m = now.points_m[rows]
    is_moving = _is_moving(things_m, [seen[other].space for other in _others(seen, place)])
    rows, things_m = rows[is_moving], things_m[is_moving]
    return [
        Clump(
            frame_index=now.frame_index,
            time_ns=int(np.median(now.times_ns[rows[own]])),
            origin_m=now.origin_m,
            points_m=things_m[own],
            ground_m=float(np.median(ground.at(things_m[own]))),
        )
        for own in _clumped(things_m, now.origin_m)
    ]


def _others(seen: Sequence[_Swept], place: int) -> list[int]:
    """Frames about the times at which the places of one are asked for."""
    times_s = np.array([float(np.median(one.times_ns)) for one in seen]) * 1e-9
    wanted_s = times_s[place] + np.array(OTHER_TIMES_S)
    inside_s = wanted_s[(wanted_s > times_s[0] - 0.3) & (wanted_s < times_s[-1] + 0.3)]
    return sorted({int(np.abs(times_s - one).argmin()) for one in inside_s} - {place})


def _is_moving(
    things_m: Float[np.ndarray, "points 3"], spaces: Sequence[SeenSpace]
) -> Bool[np.ndarray, " points"]:
    """Whether most of what is about each point stands where another sweep looked through."""
    is_passed = np.zeros(len(things_m), dtype=bool)
    for space in spaces:
        is_passed |= space.passed(things_m, beyond_m=BEYOND_M, beyond_share=BEYOND_SHARE)
    is_moving = np.zeros(len(things_m), dtype=bool)
    if not is_passed.any():
        return is_moving
    all_about = cKDTree(things_m)
    passed = cKDTree(things_m[is_passed])
    near = np.flatnonzero(passed.query(things_m, distance_upper_bound=AROUND_M)[0] < AROUND_M)
    counts = [
        tree.query_ball_point(things_m[near], AROUND_M, return_length=True)
        for tree in (passed, all_about)
    ]
    is_moving[near] = counts[0] >= LEAST_PASSED * counts[1]
    return is_moving


def _clumped(
    points_m: Float[np.ndarray, "points 3"], origin_m: Float[np.ndarray, "3"]
) -> list[Int64[np.ndarray, "_"]]:
    """Positions of the points of each clump; farther ones may be farther apart."""
    import open3d

    if len(points_m) < LEAST_IN_CLUMP:
        return []
    away_m = points_m - origin_m
    away_m[:, 2] *= 0.5  # windows part the roof from the body
    range_m = np.linalg.norm(away_m, axis=1, keepdims=True)
    drawn_in = away_m / (1 + EPS_PER_RANGE * range_m)
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(drawn_in))
    clump = np.asarray(cloud.cluster_dbscan(EPS_M, LEAST_IN_CLUMP))
    return [np.flatnonzero(clump == number) for number in range(clump.max() + 1)]
