"""Where the car drove, found by laying its LiDAR sweeps onto one another.

A turn of a milliradian that the recorded poses lack is two pixels of an image of 1920, and 3 cm of
a wall 30 m away: hundreds of points on planes tell it. Every sweep is compared with those around it
by point-to-plane distances (Chen and Medioni, 1992), and all poses are solved for at once as small
corrections of the recorded ones (Gauss-Newton with Geman and McClure's weights; the pairs make a
banded matrix). What no plane tells, such as the way along an empty road, stays as recorded.
Actors that move are left out. World: z up; metres, float64.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.linalg import solveh_banded
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from lidarpainter_models.kernels.side_by_side import side_by_side
from lidarpainter_models.lidar.moving_boxes import BACKGROUND, MovingBoxes
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


def register_sweeps(scene: DrivingScene) -> EgoCorrections:
    """Corrections of the recorded poses at the time of every swept frame.

    Nothing is corrected in a scene with sweeps in fewer than two frames.
    """
    frames = scene.swept_frames
    if len(frames) < 2:
        return EgoCorrections.none()
    boxes = MovingBoxes([track for track in scene.tracks if track.is_moving])
    swept = list(side_by_side(lambda frame: _swept(scene, frame, boxes), frames))
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
class _Swept:
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

    def moved(self, tangent: Float[np.ndarray, "6"]) -> "_Placed":
        turn = Rotation.from_rotvec(tangent[:3])
        points_m = turn.apply(self.points_m - self.centre_m) + self.centre_m + tangent[3:]
        flat_m = points_m[self.is_flat]
        return _Placed(
            points_m[self.compared],
            flat_m,
            turn.apply(self.normals[self.is_flat]),
            cKDTree(flat_m) if len(flat_m) else None,
        )


class _Placed(NamedTuple):
    """A frame's points under a correction of its pose."""

    compared_m: Float[np.ndarray, "some 3"]
    flat_m: Float[np.ndarray, "flat 3"]
    normals: Float[np.ndarray, "flat 3"]
    tree: cKDTree | None


def _swept(scene: DrivingScene, frame_index: int, boxes: MovingBoxes) -> _Swept:
    import open3d

    sweeps = scene.sweeps_of(frame_index)
    time_ns = sweeps[0].timestamp_ns
    centre = scene.world_from_ego[scene.frame_position(frame_index), :3, 3]
    xyz_m = scene.read_positions(frame_index)
    range_m = (xyz_m - centre.to(xyz_m)).norm(dim=1)
    xyz_m = xyz_m[(range_m > RANGES_M[0]) & (range_m < RANGES_M[1])]
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(xyz_m.double().numpy()))
    cloud = cloud.voxel_down_sample(CELL_M)
    around = open3d.geometry.KDTreeSearchParamHybrid(radius=PATCH_REACH_M, max_nn=PATCH_POINTS)
    if not cloud.is_empty():  # of which open3d would complain on the terminal
        cloud.estimate_covariances(around)
    points_m = np.asarray(cloud.points).reshape(-1, 3)
    variances, axes = np.linalg.eigh(np.asarray(cloud.covariances).reshape(-1, 3, 3))
    thickness, width, length = np.sqrt(np.maximum(variances, 0.0)).T
    is_thin, is_wide = thickness <= MAX_ROUGHNESS * width, width >= MAX_ROUGHNESS * length
    stands = boxes.owners(torch.from_numpy(points_m).float(), time_ns).numpy() == BACKGROUND
    standing = np.flatnonzero(stands)
    return _Swept(
        time_ns=time_ns,
        centre_m=centre.double().numpy(),
        points_m=points_m,
        normals=axes[:, :, 0],
        is_flat=is_thin & is_wide & (width > 0) & stands,
        compared=standing[:: max(1, -(-len(standing) // MOST_POINTS))],
    )


def _step(
    swept: Sequence[_Swept], tangent: Float[np.ndarray, "frames 6"]
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
    first: _Placed,
    second: _Placed,
    first_centre_m: Float[np.ndarray, "3"],
    second_centre_m: Float[np.ndarray, "3"],
) -> _Normal | None:
    if second.tree is None or not len(first.compared_m):
        return None
    away_m, nearest = second.tree.query(first.compared_m, distance_upper_bound=REACH_M)
    near = np.isfinite(away_m)
    points_m, nearest = first.compared_m[near], nearest[near]
    normals = second.normals[nearest]
    residual_m = np.einsum("pi,pi->p", normals, points_m - second.flat_m[nearest])
    weight = ((1 + (residual_m / RESIDUAL_M) ** 2) * RESIDUAL_M) ** -2.0
    of_first = np.hstack([np.cross(points_m - first_centre_m, normals), normals])
    of_second = -np.hstack([np.cross(points_m - second_centre_m, normals), normals])
    first_weighed, second_weighed = weight[:, None] * of_first, weight[:, None] * of_second
    return _Normal(
        first_weighed.T @ of_first,
        second_weighed.T @ of_second,
        first_weighed.T @ of_second,
        -first_weighed.T @ residual_m,
        -second_weighed.T @ residual_m,
    )


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
