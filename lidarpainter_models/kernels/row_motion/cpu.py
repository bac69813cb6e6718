"""Motion until a pixel is read with numba: one pass over the Gaussians."""

import math

import numba
import numpy as np
import torch
from torch import Tensor

from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.kernels.row_motion import MOST_GROWTH, NEAR_M, ROUNDS

# single precision, of which compiled code would make double beside a plain number
_ZERO, _HALF, _ONE, _TWO = (np.float32(value) for value in (0, 0.5, 1, 2))
_NEAR, _MOST, _LEAST = (np.float32(value) for value in (NEAR_M, MOST_GROWTH, 1 / MOST_GROWTH))
_SHORTEST = np.float32(1e-24)
"""Squared lengths of quaternions are taken for no less than this, as torch does."""
Vector = tuple[np.float32, np.float32, np.float32]


def motion_until_read(
    means: Tensor,
    rotation_wxyz: Tensor,
    body_index: Tensor,
    camera_from_body: Tensor,
    metres_per_s: Tensor,
    camera: Camera,
) -> tuple[Tensor, Tensor]:
    """See `row_motion.motion_until_read`."""
    columns_s, rows_s = (0.0, 0.0) if camera.shutter is None else camera.shutter.across_s
    lens = np.array(
        [
            [camera.fx_px / camera.width_px, camera.cx_px / camera.width_px - 0.5, columns_s],
            [camera.fy_px / camera.height_px, camera.cy_px / camera.height_px - 0.5, rows_s],
        ],
        np.float32,
    )
    offset_m, log_growth = _motion(
        means.contiguous().numpy(),
        rotation_wxyz.contiguous().numpy(),
        body_index.contiguous().numpy(),
        camera_from_body.contiguous().numpy(),
        metres_per_s.contiguous().numpy(),
        lens,
    )
    return torch.from_numpy(offset_m), torch.from_numpy(log_growth)


@numba.njit(cache=True, nogil=True, inline="always")
def _times(matrix: np.ndarray, x: np.float32, y: np.float32, z: np.float32) -> Vector:
    return (
        matrix[0, 0] * x + matrix[0, 1] * y + matrix[0, 2] * z,
        matrix[1, 0] * x + matrix[1, 1] * y + matrix[1, 2] * z,
        matrix[2, 0] * x + matrix[2, 1] * y + matrix[2, 2] * z,
    )


@numba.njit(cache=True, nogil=True, inline="always")
def _read_s(lens: np.ndarray, x: np.float32, y: np.float32, depth_m: np.float32) -> np.float32:
    """When a point of the camera's frame is read; `lens` is in parts of the image."""
    across = min(max(x / depth_m * lens[0, 0] + lens[0, 1], -_HALF), _HALF)
    down = min(max(y / depth_m * lens[1, 0] + lens[1, 1], -_HALF), _HALF)
    return lens[0, 2] * across + lens[1, 2] * down


@numba.njit(cache=True, nogil=True, inline="always")
def _slope(lens: np.ndarray, x: np.float32, y: np.float32, z: np.float32) -> Vector:
    """How much later a point is read per metre that it moves in the camera's frame."""
    depth_m = max(z, _NEAR)
    u, v = lens[0, 0] / depth_m, lens[1, 0] / depth_m
    by_x = u * lens[0, 2] if abs(x * u + lens[0, 1]) <= _HALF else _ZERO
    by_y = v * lens[1, 2] if abs(y * v + lens[1, 1]) <= _HALF else _ZERO
    by_z = -(by_x * x + by_y * y) / depth_m if z >= _NEAR else _ZERO
    return by_x, by_y, by_z


@numba.njit(cache=True, nogil=True, inline="always")
def _along_axes(quaternion: np.ndarray, x: np.float32, y: np.float32, z: np.float32) -> Vector:
    """A vector in the frame of the axes that a quaternion of any length turns."""
    w, i, j, k = quaternion[0], quaternion[1], quaternion[2], quaternion[3]
    twice = _TWO / max(w * w + i * i + j * j + k * k, _SHORTEST)
    # v + 2 q x (q x v - w v), q the vector part: the turn back
    cx, cy, cz = j * z - k * y - w * x, k * x - i * z - w * y, i * y - j * x - w * z
    return (
        x + twice * (j * cz - k * cy),
        y + twice * (k * cx - i * cz),
        z + twice * (i * cy - j * cx),
    )


@numba.njit(cache=True, nogil=True, parallel=True)
def _motion(
    means: np.ndarray,
    rotation_wxyz: np.ndarray,
    body_index: np.ndarray,
    poses: np.ndarray,
    rates: np.ndarray,
    lens: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    offset_m, log_growth = np.zeros_like(means), np.zeros_like(means)
    for i in numba.prange(means.shape[0]):
        pose, rate = poses[body_index[i]], rates[body_index[i]]
        x, y, z = means[i, 0], means[i, 1], means[i, 2]
        vx, vy, vz = _times(rate, x, y, z)
        vx, vy, vz = vx + rate[0, 3], vy + rate[1, 3], vz + rate[2, 3]
        # in the camera's frame
        sx, sy, sz = _times(pose, x, y, z)
        sx, sy, sz = sx + pose[0, 3], sy + pose[1, 3], sz + pose[2, 3]
        fx, fy, fz = _times(pose, vx, vy, vz)
        later_s = _ZERO
        for _ in range(ROUNDS):
            depth_m = max(sz + later_s * fz, _NEAR)
            later_s = _read_s(lens, sx + later_s * fx, sy + later_s * fy, depth_m)
        offset_m[i, 0], offset_m[i, 1], offset_m[i, 2] = later_s * vx, later_s * vy, later_s * vz
        slope = _slope(lens, sx + later_s * fx, sy + later_s * fy, sz + later_s * fz)
        gx = pose[0, 0] * slope[0] + pose[1, 0] * slope[1] + pose[2, 0] * slope[2]
        gy = pose[0, 1] * slope[0] + pose[1, 1] * slope[1] + pose[2, 1] * slope[2]
        gz = pose[0, 2] * slope[0] + pose[1, 2] * slope[1] + pose[2, 2] * slope[2]
        later = _along_axes(rotation_wxyz[i], gx, gy, gz)
        moved = _along_axes(rotation_wxyz[i], vx, vy, vz)
        for axis in range(3):
            grown = _ONE + later[axis] * moved[axis]
            log_growth[i, axis] = math.log(min(max(grown, _LEAST), _MOST))
    return offset_m, log_growth
