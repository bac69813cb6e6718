"""Numba loops of what images show of points: one pass over the points, nothing in between."""

import numba
import numpy as np
from numpy import ndarray

from lidarpainter_models.kernels import point_contrasts as rules
from lidarpainter_models.kernels.point_contrasts import AssumedCamera, SeenContrasts


def depths_before(points: ndarray, camera: AssumedCamera) -> ndarray:
    """See `point_contrasts.depths_before`."""
    depth_m = np.empty(len(points))
    _measure(points, camera, depth_m)
    return depth_m


def seen_contrasts(
    points: ndarray,
    camera: AssumedCamera,
    levels: ndarray,
    nearest_m: ndarray,
    level: int,
    hub_depth_m: ndarray,
) -> SeenContrasts:
    """See `point_contrasts.seen_contrasts`."""
    count = len(points)
    seen = SeenContrasts(
        contrast=np.empty(count),
        is_seen=np.empty(count, np.bool_),
        slope=np.empty((count, 5)),
        gradient=np.empty((count, 2)),
        motion=np.empty((count, 2, 5)),
    )
    _look(points, camera, levels, nearest_m, level, hub_depth_m, seen)
    return seen


@numba.njit(cache=True, nogil=True)
def _turned(rotation: ndarray, x: float, y: float, z: float) -> tuple[float, float, float]:
    """A vector in another frame."""
    return (
        rotation[0, 0] * x + rotation[0, 1] * y + rotation[0, 2] * z,
        rotation[1, 0] * x + rotation[1, 1] * y + rotation[1, 2] * z,
        rotation[2, 0] * x + rotation[2, 1] * y + rotation[2, 2] * z,
    )


@numba.njit(cache=True, nogil=True)
def _placed(
    point: ndarray, camera: AssumedCamera
) -> tuple[float, float, tuple[float, float, float], tuple[float, float, float], float]:
    """Pixel, place and velocity in the turned camera, and how far down the pixel lies."""
    pose, twist, lens = camera.camera_from_world, camera.twist_per_s, camera.lens
    x, y, z = _turned(pose, point[0], point[1], point[2])
    x, y, z = x + pose[0, 3], y + pose[1, 3], z + pose[2, 3]
    flow_x = -(twist[1] * z - twist[2] * y + twist[3])
    flow_y = -(twist[2] * x - twist[0] * z + twist[4])
    flow_z = -(twist[0] * y - twist[1] * x + twist[5])
    after_s, u, v, down, place = 0.0, 0.0, 0.0, 0.0, (x, y, z)
    for _ in range(rules.GUESSES):
        gone_s = camera.late_s + after_s
        moved = (x + gone_s * flow_x, y + gone_s * flow_y, z + gone_s * flow_z)
        place = _turned(camera.turned_from_camera, moved[0], moved[1], moved[2])
        ahead = max(place[2], rules.LEAST_AHEAD_M)
        u = lens[0] * place[0] / ahead + lens[2]
        v = lens[1] * place[1] / ahead + lens[3]
        across = min(max(u / lens[4] - 0.5, -0.5), 0.5)
        down = min(max(v / lens[5] - 0.5, -0.5), 0.5)
        after_s = across * camera.across_s[0] + down * camera.across_s[1]
    return u, v, place, _turned(camera.turned_from_camera, flow_x, flow_y, flow_z), down


@numba.njit(cache=True, nogil=True)
def _measure(points: ndarray, camera: AssumedCamera, depth_m: ndarray) -> None:
    """Depths of all points."""
    for index in range(len(points)):
        depth_m[index] = _placed(points[index], camera)[2][2]


@numba.njit(cache=True, nogil=True)
def _sampled(levels: ndarray, level: float, v: float, u: float) -> tuple[float, float, float]:
    """Contrast and slopes at a continuous level and pixel, linear between."""
    ends = levels.shape
    level_at = min(max(level, 0.0), ends[0] - 1.001)
    row_at = min(max(v - 0.5, 0.0), ends[1] - 1.001)
    column_at = min(max(u - 0.5, 0.0), ends[2] - 1.001)
    first, row, column = int(level_at), int(row_at), int(column_at)
    up, low, right = level_at - first, row_at - row, column_at - column
    contrast, slope_u, slope_v = 0.0, 0.0, 0.0
    for corner in range(8):
        i, j, k = corner >> 2, (corner >> 1) & 1, corner & 1
        weight = (up if i else 1 - up) * (low if j else 1 - low) * (right if k else 1 - right)
        contrast += weight * levels[first + i, row + j, column + k, 0]
        slope_u += weight * levels[first + i, row + j, column + k, 1]
        slope_v += weight * levels[first + i, row + j, column + k, 2]
    return contrast, slope_u, slope_v


@numba.njit(cache=True, nogil=True)
def _is_seen(
    u: float, v: float, depth: float, octaves: float, lens: ndarray, nearest_m: ndarray
) -> bool:
    """Whether a point is compared there."""
    if not (depth > rules.NEAR_M and abs(octaves) < 1):
        return False
    if not (u > rules.BORDER_PX and u < lens[4] - rules.BORDER_PX):
        return False
    if not (v > rules.BORDER_PX and v < lens[5] - rules.BORDER_PX):
        return False
    return bool(depth <= float(nearest_m[int(v), int(u)]) * rules.HIDDEN + rules.HIDDEN_M)


@numba.njit(cache=True, nogil=True)
def _look(
    points: ndarray,
    camera: AssumedCamera,
    levels: ndarray,
    nearest_m: ndarray,
    level: int,
    hub_depth_m: ndarray,
    seen: SeenContrasts,
) -> None:
    """Everything about all points."""
    lens, change = camera.lens, np.zeros((3, 5))
    for index in range(len(points)):
        u, v, (x, y, depth), flow, down = _placed(points[index], camera)
        hub_m = max(hub_depth_m[index], rules.LEAST_DEPTH_M)
        octaves = np.log2(hub_m / max(depth, rules.LEAST_DEPTH_M))
        is_seen = _is_seen(u, v, depth, octaves, lens, nearest_m)
        found = _sampled(levels, level + rules.LEVELS_PER_OCTAVE * octaves, v, u)
        contrast, slope_u, slope_v = found
        change[0, 1], change[0, 2] = -depth, y
        change[1, 0], change[1, 2] = depth, -x
        change[2, 0], change[2, 1] = -y, x
        for axis in range(3):
            change[axis, rules.LATE], change[axis, rules.READOUT] = flow[axis], flow[axis] * down
        scale, ahead = max(depth, rules.LEAST_SCALE_M), max(depth, rules.LEAST_AHEAD_M)
        seen.contrast[index], seen.is_seen[index] = contrast, is_seen
        seen.gradient[index, 0] = slope_u / scale if is_seen else 0.0
        seen.gradient[index, 1] = slope_v / scale if is_seen else 0.0
        slant_u, slant_v = (u - lens[2]) / ahead, (v - lens[3]) / ahead
        for one in range(5):
            moved_u = lens[0] * change[0, one] / ahead - slant_u * change[2, one]
            moved_v = lens[1] * change[1, one] / ahead - slant_v * change[2, one]
            seen.slope[index, one] = slope_u * moved_u + slope_v * moved_v
            seen.motion[index, 0, one] = scale * moved_u
            seen.motion[index, 1, one] = scale * moved_v
