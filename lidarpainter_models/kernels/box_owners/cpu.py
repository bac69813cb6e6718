"""Which box holds a point with numba: a point leaves a box at the first axis that misses it."""

import numba
import numpy as np
import torch
from torch import Tensor


def box_owners(
    points_m: Tensor, box_from_points: Tensor, size_m: Tensor, margin_m: float, floor_m: float
) -> Tensor:
    """See `box_owners.box_owners`."""
    owners = _owners(
        points_m.contiguous().numpy(),
        box_from_points.contiguous().numpy(),
        (size_m / 2).contiguous().numpy(),
        points_m.numpy().dtype.type(margin_m),
        points_m.numpy().dtype.type(floor_m),
    )
    return torch.from_numpy(owners)


@numba.njit(cache=True, nogil=True, inline="always")
def _along(pose: np.ndarray, axis: int, point: np.ndarray) -> float:
    turned = pose[axis, 0] * point[0] + pose[axis, 1] * point[1] + pose[axis, 2] * point[2]
    return turned + pose[axis, 3]


@numba.njit(cache=True, nogil=True, parallel=True)
def _owners(
    points_m: np.ndarray, poses: np.ndarray, half_m: np.ndarray, margin_m: float, floor_m: float
) -> np.ndarray:
    owners = np.full(points_m.shape[0], -1, np.int64)
    for i in numba.prange(points_m.shape[0]):
        point = points_m[i]
        for box in range(poses.shape[0] - 1, -1, -1):
            x = abs(_along(poses[box], 0, point))
            if not x <= half_m[box, 0] + margin_m:
                continue
            y = abs(_along(poses[box], 1, point))
            if not y <= half_m[box, 1] + margin_m:
                continue
            z = _along(poses[box], 2, point)
            over_floor_m = z + half_m[box, 2]
            if not abs(z) <= half_m[box, 2] + margin_m:
                continue
            is_inside = x <= half_m[box, 0] and y <= half_m[box, 1] and over_floor_m > 0
            if is_inside or over_floor_m > floor_m:
                owners[i] = box
                break
    return owners
