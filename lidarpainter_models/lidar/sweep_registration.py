"""Where the car drove, found by laying its LiDAR sweeps onto one another.

A turn of a milliradian that the recorded poses lack is two pixels of an image of 1920, and 3 cm of
a wall 30 m away: hundreds of points on planes tell it. Every sweep is compared with those around it
by point-to-plane distances (Chen and Medioni, 1992), and all poses are solved for at once as small
corrections of the recorded ones (Gauss-Newton with Geman and McClure's weights; the pairs make a
banded matrix). What no plane tells, such as the way along an empty road, stays as recorded.
Actors that move are left out. World: z up; metres, float64.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.linalg import solveh_banded
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from lidarpainter_models.kernels.side_by_side import side_by_side
from lidarpainter_models.lidar.points_on_actors import BACKGROUND, MovingBoxes
from lidarpainter_models.scenes.driving_scene import DrivingScene
from lidarpainter_models.scenes.ego_corrections import EgoCorrections

NEIGHBOURS = 3
"""Sweeps before and after that each is compared with."""
RANGES_M = (3.0, 70.0)
CELL_M, PATCH_POINTS, PATCH_REACH_M = 0.25, 10, 1.0
"""Planes go through one point per cell: a LiDAR's next points lie along a line."""
MAX_ROUGHNESS = 0.2
"""Thickness of a plane over its narrower extent; leaves have no one direction."""
MOST_POINTS = 1500
"""Of a sweep, which are compared with each neighbour."""
REACH_M, RESIDUAL_M = 0.4, 0.04
"""How far the other sweep's plane may be, and the distance from which on points count little."""
EXPECTED = np.array([3e-3] * 3 + [0.05] * 3)
"""Errors of recorded poses that surprise nobody: rad and m."""
MOST_ROUNDS, STILL_RAD = 8, 5e-5
COARSE_TO_FINE_M = ((3.0, 0.5), (1.0, 0.15), (0.4, 0.04))
"""How far a plane may be, and the distance from which on points count little."""
MOST_STEPS, STILL = 12, 1e-4
SURPRISE = np.array([0.03] * 3 + [0.5] * 3)
"""By how much (rad, m) the motion of a tenth of a second surprises: all that holds a car along an
empty road."""
LAID_M = 0.1
"""A point nearer to its plane lies on it."""
MOST_FLAT = 4000
"""Planes of a frame that others are laid onto."""


def register_sweeps(scene: DrivingScene) -> EgoCorrections:
    """Corrections of the recorded poses at the time of every swept frame.

    Nothing is corrected in a scene with sweeps in fewer than two frames.
    """
    frames = scene.swept_frames
    if len(frames) < 2:
        return EgoCorrections.none()
    boxes = MovingBoxes([track for track in scene.tracks if track.is_moving])
    return settled(list(side_by_side(lambda frame: _swept(scene, frame, boxes), frames)))


def settled(swept: Sequence["SweptFrame"]) -> EgoCorrections:
    """Corrections under which the sweeps of two frames or more lie best onto one another."""
    tangent = np.zeros((len(swept), 6))
    for _ in range(MOST_ROUNDS):
        step = _step(swept, tangent)
        tangent += step
        if np.abs(step[:, :3]).max() < STILL_RAD:
            break
    return EgoCorrections(
        times_ns=torch.tensor([one.time_ns for one in swept]),
        centre_m=torch.from_numpy(np.stack([one.centre_m for one in swept])),
        tangent=torch.from_numpy(tangent),
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class SweptFrame:
    """What the LiDARs saw of the street in one frame, as recorded."""

    time_ns: int
    centre_m: Float[np.ndarray, "3"]
    points_m: Float[np.ndarray, "points 3"]
    """One of every cell."""
    normals: Float[np.ndarray, "points 3"]
    is_flat: Bool[np.ndarray, " points"]
    """Where a plane goes through a point and those around it, along its normal."""
    compared: Int[np.ndarray, " some"]
    """An even sample of the points."""

    @classmethod
    def of(
        cls,
        xyz_m: Float[np.ndarray, "points 3"],
        centre_m: Float[np.ndarray, "3"],
        time_ns: int,
        stands: Callable[[np.ndarray], Bool[np.ndarray, " points"]] | None = None,
    ) -> "SweptFrame":
        """Find the planes among points in range of a place; only what `stands`, or all, is used."""
        import open3d

        range_m = np.linalg.norm(xyz_m - centre_m, axis=1)
        xyz_m = xyz_m[(range_m > RANGES_M[0]) & (range_m < RANGES_M[1])]
        cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(xyz_m.astype(np.float64)))
        cloud = cloud.voxel_down_sample(CELL_M)
        around = open3d.geometry.KDTreeSearchParamHybrid(radius=PATCH_REACH_M, max_nn=PATCH_POINTS)
        if not cloud.is_empty():  # of which open3d would complain on the terminal
            cloud.estimate_covariances(around)
        points_m = np.asarray(cloud.points).reshape(-1, 3)
        variances, axes = np.linalg.eigh(np.asarray(cloud.covariances).reshape(-1, 3, 3))
        thickness, width, length = np.sqrt(np.maximum(variances, 0.0)).T
        is_thin, is_wide = thickness <= MAX_ROUGHNESS * width, width >= MAX_ROUGHNESS * length
        is_used = np.ones(len(points_m), bool) if stands is None else stands(points_m)
        standing = np.flatnonzero(is_used)
        return cls(
            time_ns=time_ns,
            centre_m=centre_m.astype(np.float64),
            points_m=points_m,
            normals=axes[:, :, 0],
            is_flat=is_thin & is_wide & (width > 0) & is_used,
            compared=standing[:: max(1, -(-len(standing) // MOST_POINTS))],
        )

    def moved(self, tangent: Float[np.ndarray, "6"]) -> "Placed":
        """The points under a small motion: turned about the centre, then shifted."""
        turn = Rotation.from_rotvec(tangent[:3])
        points_m = turn.apply(self.points_m - self.centre_m) + self.centre_m + tangent[3:]
        flat_m = points_m[self.is_flat]
        return Placed.of(points_m[self.compared], flat_m, turn.apply(self.normals[self.is_flat]))


class Placed(NamedTuple):
    """Points before planes that others are laid onto."""

    compared_m: Float[np.ndarray, "some 3"]
    flat_m: Float[np.ndarray, "flat 3"]
    normals: Float[np.ndarray, "flat 3"]
    tree: cKDTree | None

    @classmethod
    def of(cls, compared_m: np.ndarray, flat_m: np.ndarray, normals: np.ndarray) -> "Placed":
        """Take points and planes as they are."""
        return cls(compared_m, flat_m, normals, cKDTree(flat_m) if len(flat_m) else None)


def _swept(scene: DrivingScene, frame_index: int, boxes: MovingBoxes) -> SweptFrame:
    time_ns = scene.sweeps_of(frame_index)[0].timestamp_ns
    centre = scene.world_from_ego[scene.frame_position(frame_index), :3, 3]

    def stands(points_m: np.ndarray) -> np.ndarray:
        return boxes.owners(torch.from_numpy(points_m).float(), time_ns).numpy() == BACKGROUND

    return SweptFrame.of(scene.read_positions(frame_index).numpy(), centre.numpy(), time_ns, stands)


def _step(
    swept: Sequence[SweptFrame], tangent: Float[np.ndarray, "frames 6"]
) -> Float[np.ndarray, "frames 6"]:
    """One step of Gauss and Newton for the poses of all frames."""
    placed = [one.moved(own) for one, own in zip(swept, tangent, strict=True)]
    count, reach = len(swept), min(NEIGHBOURS, len(swept) - 1)
    pairs = [
        (first, second)
        for first in range(count)
        for second in range(max(0, first - reach), min(count, first + reach + 1))
        if first != second
    ]

    def compared(pair: tuple[int, int]) -> _Normal | None:
        first, second = pair
        centres = swept[first].centre_m, swept[second].centre_m
        return _normal_equations(placed[first], placed[second], *centres)

    # blocks[place, frame] is that of a frame and the one so many places after it
    blocks, right = np.zeros((reach + 1, count, 6, 6)), np.zeros((count, 6))
    for (first, second), found in zip(pairs, side_by_side(compared, pairs), strict=True):
        if found is None:
            continue
        blocks[0, first] += found.first
        blocks[0, second] += found.second
        between = found.between if first < second else found.between.T
        blocks[abs(first - second), min(first, second)] += between
        right[first] += found.right_first
        right[second] += found.right_second
    blocks[0] += np.diag(EXPECTED**-2.0)
    right -= EXPECTED**-2.0 * tangent
    return solveh_banded(_banded(blocks), right.ravel(), lower=True).reshape(-1, 6)


class _Normal(NamedTuple):
    """The part of the normal equations that the points of one frame on another's planes make."""

    first: Float[np.ndarray, "6 6"]
    second: Float[np.ndarray, "6 6"]
    between: Float[np.ndarray, "6 6"]
    """Rows of the first frame, columns of the second."""
    right_first: Float[np.ndarray, "6"]
    right_second: Float[np.ndarray, "6"]


def _normal_equations(
    first: Placed,
    second: Placed,
    first_centre_m: Float[np.ndarray, "3"],
    second_centre_m: Float[np.ndarray, "3"],
) -> _Normal | None:
    met = planes_met(first.compared_m, second, reach_m=REACH_M)
    if met is None:
        return None
    weight = robust_weight(met.residual_m, RESIDUAL_M)
    of_first = met.slopes(first_centre_m)
    of_second = -met.slopes(second_centre_m)
    first_weighed, second_weighed = weight[:, None] * of_first, weight[:, None] * of_second
    return _Normal(
        first_weighed.T @ of_first,
        second_weighed.T @ of_second,
        first_weighed.T @ of_second,
        -first_weighed.T @ met.residual_m,
        -second_weighed.T @ met.residual_m,
    )


class PlanesMet(NamedTuple):
    """Points that have a plane near them."""

    rows: Int[np.ndarray, " met"]
    """Position among the points asked for."""
    points_m: Float[np.ndarray, "met 3"]
    normals: Float[np.ndarray, "met 3"]
    residual_m: Float[np.ndarray, " met"]
    """From the plane, along its normal."""

    def slopes(self, centre_m: Float[np.ndarray, "3"]) -> Float[np.ndarray, "met 6"]:
        """How residuals grow as the points are turned about a centre (rad) and shifted (m)."""
        return np.hstack([np.cross(self.points_m - centre_m, self.normals), self.normals])


def planes_met(
    points_m: Float[np.ndarray, "points 3"], onto: Placed, *, reach_m: float
) -> PlanesMet | None:
    """The nearest plane of each point within reach; None where there are no points or planes."""
    if onto.tree is None or not len(points_m):
        return None
    away_m, nearest = onto.tree.query(points_m, distance_upper_bound=reach_m)
    rows = np.flatnonzero(np.isfinite(away_m))
    points_m, nearest = points_m[rows], nearest[rows]
    normals = onto.normals[nearest]
    residual_m = np.einsum("pi,pi->p", normals, points_m - onto.flat_m[nearest])
    return PlanesMet(rows, points_m, normals, residual_m)


def robust_weight(
    residual_m: Float[np.ndarray, " points"], scale_m: float
) -> Float[np.ndarray, " points"]:
    """Geman and McClure's weights, 1 / m2: far beyond the scale a residual counts nothing."""
    return np.asarray(((1 + (residual_m / scale_m) ** 2) * scale_m) ** -2.0)


def planes_of(frames: Sequence[SweptFrame]) -> Placed:
    """Some planes of each of several frames."""
    flat, normals = [], []
    for frame in frames:
        rows = np.flatnonzero(frame.is_flat)
        rows = rows[:: max(1, -(-len(rows) // MOST_FLAT))]
        flat.append(frame.points_m[rows])
        normals.append(frame.normals[rows])
    return Placed.of(np.zeros((0, 3)), np.concatenate(flat), np.concatenate(normals))


def laid(
    points_m: Float[np.ndarray, "points 3"],
    onto: Placed,
    centre_m: Float[np.ndarray, "3"],
    steps: Sequence[tuple[float, float]] = COARSE_TO_FINE_M,
) -> tuple[Float[np.ndarray, "4 4"] | None, float]:
    """The motion that lays points onto planes, None if they meet none; the share then on a plane.

    Args:
        points_m: what is moved, where it is thought to be.
        onto: the planes.
        centre_m: about which it is turned.
        steps: how far planes are looked for and which distances count, from coarse to fine.
    """
    motion, moved_m, prior = np.eye(4), points_m, np.diag(SURPRISE**-2.0)
    strayed = np.zeros(6)
    for reach_m, scale_m in steps:
        for _ in range(MOST_STEPS):
            met = planes_met(moved_m, onto, reach_m=reach_m)
            if met is None or not len(met.rows):
                return None, 0.0
            weight, slopes = robust_weight(met.residual_m, scale_m), met.slopes(centre_m)
            weighed = weight[:, None] * slopes
            right = -weighed.T @ met.residual_m - prior @ strayed
            step = np.linalg.solve(weighed.T @ slopes + prior, right)
            strayed = strayed + step
            turn = np.eye(4)
            turn[:3, :3] = Rotation.from_rotvec(step[:3]).as_matrix()
            turn[:3, 3] = step[3:] + centre_m - turn[:3, :3] @ centre_m
            motion = turn @ motion
            moved_m = points_m @ motion[:3, :3].T + motion[:3, 3]
            if np.abs(step).max() < STILL:
                break
    met = planes_met(moved_m, onto, reach_m=PATCH_REACH_M)
    on_it = 0 if met is None else int((np.abs(met.residual_m) < LAID_M).sum())
    return motion, on_it / max(1, len(points_m))


def _banded(blocks: Float[np.ndarray, "places frames 6 6"]) -> Float[np.ndarray, "band numbers"]:
    """The lower diagonals of the symmetric matrix of these blocks, as LAPACK takes them."""
    places, count = blocks.shape[:2]
    banded = np.zeros((6 * places, 6 * count))
    for place in range(places):
        for row in range(6):
            for column in range(6):
                diagonal = 6 * place + row - column
                if diagonal >= 0:
                    own = blocks[place, : count - place, column, row]
                    banded[diagonal, column : 6 * (count - place) : 6] = own
    return banded
