"""How far apart two sweeps of LiDARs lie in the world; metres, float64.

Poses or motion compensation that are off move a whole sweep. What else parts two sweeps must not
count: where the beams happen to fall, and surfaces that only one of them holds because a LiDAR was
silent for a frame or its file is damaged in places.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import KDTree
from torch import Tensor

NEIGHBOURHOOD_M = 25.0
"""Around the car, where two sweeps are dense enough to be compared."""
_NUM_SAMPLED_POINTS = 3000
_PATCH_CELL_M = 0.25
"""Patches are made of one point per cell: a LiDAR's next points lie along a line."""
_PATCH_POINTS = 8
_PATCH_REACH_M = 1.0
_MAX_ROUGHNESS = 0.2
"""Thickness of a patch over its narrower extent; curbs and leaves have no one direction."""
_MIN_COMPARED = 50
_NUM_REWEIGHTINGS = 10
_LEAST_RESIDUAL_M = 0.01
"""Smaller ones weigh no more: the noise of a LiDAR."""
_MOST_UNEXPLAINED = 0.67
"""Of the residuals. Tried once on seven pairs: sound ones kept 0.82, those moved by 0.2 m 0.58."""
_LEAST_SHARE = 0.03
"""Of all planes that must pin down a way of moving: the rest is what corners make up."""


def points_near(
    xyz_m: Float[Tensor, "points 3"], centre_m: Float[Tensor, "3"]
) -> Float[np.ndarray, "near 3"]:
    """The points around a place among which two sweeps are compared."""
    xyz_m = xyz_m.double()
    return xyz_m[(xyz_m - centre_m).norm(dim=1) < NEIGHBOURHOOD_M].numpy()


def nearest_gap_m(
    first_m: Float[np.ndarray, "first 3"], second_m: Float[np.ndarray, "second 3"]
) -> float | None:
    """Median distance from points of one sweep to the nearest of another; None without any."""
    if len(first_m) == 0 or len(second_m) == 0:
        return None
    return float(np.median(KDTree(second_m).query(some_of(first_m))[0]))


def sweep_offset_m(
    first_m: Float[np.ndarray, "first 3"], second_m: Float[np.ndarray, "second 3"]
) -> float | None:
    """How far apart two sweeps hold the surfaces that both saw.

    One linearised step of point-to-plane registration (Chen and Medioni, 1992) with least absolute
    residuals gives the motion that best explains them. If it explains a third of their sum, the
    answer is the median displacement of the points by it; otherwise nothing has moved as a whole,
    and it is the median residual. Only points around which the other sweep makes a plane take part;
    None where too few do. A shift that no plane pins down (along an empty road) is not seen.
    """
    forth, back = _plane_residuals(first_m, second_m), _plane_residuals(second_m, first_m)
    points_m = np.concatenate([forth.points_m, back.points_m])
    if len(points_m) < _MIN_COMPARED:
        return None
    normals = np.concatenate([forth.normals, -back.normals])
    residuals_m = np.concatenate([forth.residuals_m, back.residuals_m])
    away_m = points_m - points_m.mean(axis=0)
    turn, shift_m = _least_absolute_motion(away_m, normals, residuals_m)
    motion_m = np.cross(turn, away_m) + shift_m
    unexplained_m = residuals_m - np.einsum("pi,pi->p", normals, motion_m)
    if np.abs(unexplained_m).sum() > _MOST_UNEXPLAINED * np.abs(residuals_m).sum():
        return float(np.median(np.abs(residuals_m)))
    return float(np.median(np.linalg.norm(motion_m, axis=1)))


def some_of(points_m: np.ndarray) -> np.ndarray:
    """An even sample of the points."""
    return points_m[:: max(1, len(points_m) // _NUM_SAMPLED_POINTS)]


class _PlaneResiduals(NamedTuple):
    """Points of one sweep before planes of another."""

    points_m: Float[np.ndarray, "compared 3"]
    normals: Float[np.ndarray, "compared 3"]
    residuals_m: Float[np.ndarray, " compared"]
    """Of the points along the normals."""


def _plane_residuals(from_m: np.ndarray, to_m: np.ndarray) -> _PlaneResiduals:
    import open3d

    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(to_m))
    patch_m = np.asarray(cloud.voxel_down_sample(_PATCH_CELL_M).points)
    some_m = some_of(from_m)
    if len(patch_m) < _PATCH_POINTS or len(some_m) == 0:
        return _PlaneResiduals(np.empty((0, 3)), np.empty((0, 3)), np.empty(0))
    reached_m, neighbours = KDTree(patch_m).query(
        some_m, k=_PATCH_POINTS, distance_upper_bound=_PATCH_REACH_M
    )
    whole = np.isfinite(reached_m).all(axis=1)
    around_m = patch_m[neighbours[whole]]
    centre_m = around_m.mean(axis=1)
    spread = np.einsum("pki,pkj->pij", around_m - centre_m[:, None], around_m - centre_m[:, None])
    variances, axes = np.linalg.eigh(spread)
    flat, normals = _is_plane(variances), axes[:, :, 0]
    residuals_m = np.einsum("pi,pi->p", some_m[whole] - centre_m, normals)
    return _PlaneResiduals(some_m[whole][flat], normals[flat], residuals_m[flat])


def _least_absolute_motion(
    points_m: np.ndarray, normals: np.ndarray, residuals_m: np.ndarray
) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    """Turn (rad) and shift that explain residuals along normals, by reweighted least squares."""
    reach_m = float(np.sqrt((points_m**2).sum(axis=1).mean()))
    columns = np.hstack([np.cross(points_m, normals) / reach_m, normals])
    strength, ways = np.linalg.eigh(columns.T @ columns)
    ways = ways[:, strength >= _LEAST_SHARE * strength.sum()]
    columns, weights = columns @ ways, np.ones(len(columns))
    for _ in range(_NUM_REWEIGHTINGS):
        weighted = columns * weights[:, None]
        along = np.linalg.solve(weighted.T @ columns, weighted.T @ residuals_m)
        weights = 1.0 / np.maximum(np.abs(residuals_m - columns @ along), _LEAST_RESIDUAL_M)
    motion = ways @ along
    return motion[:3] / reach_m, motion[3:]


def _is_plane(variances: Float[np.ndarray, "patches 3"]) -> Bool[np.ndarray, " patches"]:
    """Whether patches, of ascending variances along their axes, are thin and no line."""
    thickness, width, length = np.sqrt(np.maximum(variances, 0.0)).T
    return (thickness <= _MAX_ROUGHNESS * width) & (width >= _MAX_ROUGHNESS * length)
