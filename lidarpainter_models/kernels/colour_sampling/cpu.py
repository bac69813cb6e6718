"""Numba loops of the colouring: project points, take samples from an image, combine them.

Every point is handled by one thread alone, so the number of threads changes no bit.
"""

import numba
import numpy as np
import torch
from torch import Tensor

from lidarpainter_models.kernels.colour_sampling import AGREEMENT, READ_MARGIN, SLOTS, BestSamples


def project_inside(
    xyz_m: Tensor, pixels_from_points: Tensor, width_px: int, height_px: int, near_m: float
) -> tuple[Tensor, Tensor, Tensor]:
    """See `colour_sampling.project_inside`."""
    found = _project_inside(
        xyz_m.contiguous().numpy(), pixels_from_points.numpy(), width_px, height_px, near_m
    )
    rows, pixels_uv, depth_m = (torch.from_numpy(column) for column in found)
    return rows, pixels_uv, depth_m


@numba.njit(cache=True, nogil=True)
def _project_inside(
    xyz_m: np.ndarray, pixels_from_points: np.ndarray, width_px: int, height_px: int, near_m: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rows, continuous pixels (rows, 2) and depth of the points that fall into an image."""
    m = pixels_from_points.astype(np.float32)
    near = np.float32(near_m)
    width, height = np.float32(width_px), np.float32(height_px)
    rows = np.empty(xyz_m.shape[0], dtype=np.int64)
    pixels_uv = np.empty((xyz_m.shape[0], 2), dtype=np.float32)
    depth_m = np.empty(xyz_m.shape[0], dtype=np.float32)
    count = 0
    for i in range(xyz_m.shape[0]):
        x, y, z = xyz_m[i, 0], xyz_m[i, 1], xyz_m[i, 2]
        depth = m[2, 0] * x + m[2, 1] * y + m[2, 2] * z + m[2, 3]
        if depth < near:
            continue
        u = (m[0, 0] * x + m[0, 1] * y + m[0, 2] * z + m[0, 3]) / depth
        v = (m[1, 0] * x + m[1, 1] * y + m[1, 2] * z + m[1, 3]) / depth
        if u >= 0 and v >= 0 and u < width and v < height:
            rows[count] = i
            pixels_uv[count, 0], pixels_uv[count, 1] = u, v
            depth_m[count] = depth
            count += 1
    return rows[:count].copy(), pixels_uv[:count].copy(), depth_m[:count].copy()


def read_inside(
    xyz_m: Tensor, camera: Tensor, margin_px: float, near_m: float, rounds: int
) -> tuple[Tensor, Tensor, Tensor]:
    """See `colour_sampling.read_inside`."""
    found = _read_inside(xyz_m.contiguous().numpy(), camera.numpy(), margin_px, near_m, rounds)
    rows, pixels_uv, depth_m = (torch.from_numpy(column) for column in found)
    return rows, pixels_uv, depth_m


def in_any_image(xyz_m: Tensor, cameras: Tensor, near_m: float, rounds: int) -> Tensor:
    """See `colour_sampling.in_any_image`."""
    inside = _in_any_image(xyz_m.contiguous().numpy(), cameras.numpy(), near_m, rounds)
    return torch.from_numpy(inside)


@numba.njit(cache=True, nogil=True)
def _standing(camera: np.ndarray, xyz_m: np.ndarray) -> tuple[float, float, float]:
    """A point in the camera's frame in the middle of its image; float64."""
    x, y, z = np.float64(xyz_m[0]), np.float64(xyz_m[1]), np.float64(xyz_m[2])
    return (
        camera[0] * x + camera[1] * y + camera[2] * z + camera[3],
        camera[4] * x + camera[5] * y + camera[6] * z + camera[7],
        camera[8] * x + camera[9] * y + camera[10] * z + camera[11],
    )


@numba.njit(cache=True, nogil=True)
def _pixel(camera: np.ndarray, x: float, y: float, z: float) -> tuple[float, float]:
    """Where a point of the camera's frame is seen."""
    depth = z if abs(z) >= 1e-9 else 1e-9
    return x / depth * camera[12] + camera[14], y / depth * camera[13] + camera[15]


@numba.njit(cache=True, nogil=True)
def _read(
    camera: np.ndarray, x: float, y: float, z: float, rounds: int
) -> tuple[float, float, float]:
    """Pixel and depth of a standing point where the shutter reads it; see `Camera.project`."""
    turn_x, turn_y, turn_z = camera[20], camera[21], camera[22]
    velocity_x = turn_z * y - turn_y * z - camera[23]
    velocity_y = turn_x * z - turn_z * x - camera[24]
    velocity_z = turn_y * x - turn_x * y - camera[25]
    (u, v), depth = _pixel(camera, x, y, z), z
    for _ in range(rounds):
        across = min(max(u / camera[16] - 0.5, -0.5), 0.5)
        down = min(max(v / camera[17] - 0.5, -0.5), 0.5)
        after_s = camera[18] * across + camera[19] * down
        depth = z + after_s * velocity_z
        u, v = _pixel(camera, x + after_s * velocity_x, y + after_s * velocity_y, depth)
    return u, v, depth


@numba.njit(cache=True, nogil=True)
def _read_inside(
    xyz_m: np.ndarray, camera: np.ndarray, margin_px: float, near_m: float, rounds: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rows, continuous pixels (rows, 2) and depth of the points that an image is read with."""
    width_px, height_px = camera[16] + 2 * margin_px, camera[17] + 2 * margin_px
    aside_px, above_px = READ_MARGIN * width_px, READ_MARGIN * height_px
    rows = np.empty(xyz_m.shape[0], dtype=np.int64)
    pixels_uv = np.empty((xyz_m.shape[0], 2), dtype=np.float32)
    depth_m = np.empty(xyz_m.shape[0], dtype=np.float32)
    count = 0
    for i in range(xyz_m.shape[0]):
        x, y, z = _standing(camera, xyz_m[i])
        if z < near_m:
            continue
        u, v = _pixel(camera, x, y, z)
        u, v = u + margin_px, v + margin_px
        if not (-aside_px <= u < width_px + aside_px and -above_px <= v < height_px + above_px):
            continue
        u, v, read_m = _read(camera, x, y, z, rounds)
        # as they are given on: what rounds up to the edge is outside
        u_px, v_px = np.float32(u + margin_px), np.float32(v + margin_px)
        if read_m > near_m and 0 <= u_px < width_px and 0 <= v_px < height_px:
            rows[count] = i
            pixels_uv[count, 0], pixels_uv[count, 1] = u_px, v_px
            depth_m[count] = read_m
            count += 1
    return rows[:count].copy(), pixels_uv[:count].copy(), depth_m[:count].copy()


@numba.njit(cache=True, nogil=True)
def _in_any_image(xyz_m: np.ndarray, cameras: np.ndarray, near_m: float, rounds: int) -> np.ndarray:
    """Whether each point falls into an image, of the cameras in their order."""
    inside = np.zeros(xyz_m.shape[0], dtype=np.bool_)
    for i in range(xyz_m.shape[0]):
        for number in range(cameras.shape[0]):
            camera = cameras[number]
            x, y, z = _standing(camera, xyz_m[i])
            u, v, depth_m = _read(camera, x, y, z, rounds)
            if depth_m > near_m and 0 <= u < camera[16] and 0 <= v < camera[17]:
                inside[i] = True
                break
    return inside


@numba.njit(cache=True, nogil=True, parallel=True)
def insert_samples(
    best: BestSamples, rows: np.ndarray, weight: np.ndarray, rgb: np.ndarray, view: int
) -> None:
    """See `colour_sampling.insert_samples`."""
    slot_weight, slot_rgb, slot_view = best
    for i in numba.prange(rows.shape[0]):
        row, w = rows[i], weight[i]
        slot = SLOTS
        while slot > 0 and w > slot_weight[row, slot - 1]:
            slot -= 1
        if slot == SLOTS:
            continue
        for k in range(SLOTS - 1, slot, -1):
            slot_weight[row, k] = slot_weight[row, k - 1]
            slot_view[row, k] = slot_view[row, k - 1]
            for c in range(3):
                slot_rgb[row, k, c] = slot_rgb[row, k - 1, c]
        slot_weight[row, slot] = w
        slot_view[row, slot] = view
        for c in range(3):
            slot_rgb[row, slot, c] = rgb[i, c]


@numba.njit(cache=True, nogil=True, parallel=True)
def steps_inside(
    cells_uv: np.ndarray, depth_m: np.ndarray, inner_m: np.ndarray, reach: int, tolerance: float
) -> tuple[np.ndarray, np.ndarray]:
    """See `colour_sampling.steps_inside`."""
    steps = np.zeros((depth_m.shape[0], 2), dtype=np.float32)
    is_found = np.zeros(depth_m.shape[0], dtype=np.bool_)
    for i in numba.prange(depth_m.shape[0]):
        column, row, z = cells_uv[i, 0], cells_uv[i, 1], depth_m[i]
        best = reach * reach + 1
        for r in range(max(row - reach, 0), min(row + reach + 1, inner_m.shape[0])):
            for c in range(max(column - reach, 0), min(column + reach + 1, inner_m.shape[1])):
                distance = (r - row) * (r - row) + (c - column) * (c - column)
                if distance < best and abs(inner_m[r, c] - z) <= tolerance * z:
                    best = distance
                    steps[i, 0], steps[i, 1] = c - column, r - row
                    is_found[i] = True
    return steps, is_found


@numba.njit(cache=True, nogil=True, parallel=True)
def sample_levels(
    pixels_uv: np.ndarray,
    level: np.ndarray,
    finest: np.ndarray,
    middle: np.ndarray,
    coarsest: np.ndarray,
) -> np.ndarray:
    """See `colour_sampling.sample_levels`."""
    rgb = np.empty((pixels_uv.shape[0], 3), dtype=np.uint8)
    for i in numba.prange(pixels_uv.shape[0]):
        u, v = pixels_uv[i, 0], pixels_uv[i, 1]
        if level[i] == 0:
            _bilinear(finest, u, v, rgb[i])
        elif level[i] == 1:
            _bilinear(middle, u * 0.5, v * 0.5, rgb[i])
        else:
            _bilinear(coarsest, u * 0.25, v * 0.25, rgb[i])
    return rgb


@numba.njit(cache=True, nogil=True)
def _bilinear(image: np.ndarray, u: float, v: float, rgb: np.ndarray) -> None:
    """Mix of the four pixels around a position (pixel centres at halves), edges repeated."""
    height, width = image.shape[0], image.shape[1]
    u = min(max(u - 0.5, 0.0), width - 1.0)
    v = min(max(v - 0.5, 0.0), height - 1.0)
    column, row = int(u), int(v)
    right, below = min(column + 1, width - 1), min(row + 1, height - 1)
    fu, fv = u - column, v - row
    for c in range(3):
        top = (1 - fu) * image[row, column, c] + fu * image[row, right, c]
        bottom = (1 - fu) * image[below, column, c] + fu * image[below, right, c]
        rgb[c] = np.uint8((1 - fv) * top + fv * bottom + 0.5)


@numba.njit(cache=True, nogil=True, parallel=True)
def combine_samples(best: BestSamples, view_gain: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """See `colour_sampling.combine_samples`."""
    slot_weight, slot_rgb, slot_view = best
    points = slot_weight.shape[0]
    rgb = np.zeros((points, 3), dtype=np.uint8)
    has_colour = np.zeros(points, dtype=np.bool_)
    for i in numba.prange(points):
        count = 0
        while count < SLOTS and slot_weight[i, count] > 0:
            count += 1
        if count == 0:
            continue
        has_colour[i] = True
        matched = np.empty((SLOTS, 3), dtype=np.float32)
        for k in range(count):
            for c in range(3):
                matched[k, c] = slot_rgb[i, k, c] * view_gain[slot_view[i, k], c]
        _agreed_colour(matched, slot_weight[i], count, rgb[i])
    return rgb, has_colour


@numba.njit(cache=True, nogil=True)
def _median_slot(matched: np.ndarray, weight: np.ndarray, count: int) -> int:
    """The slot whose brightness is the weighted median; the lower slot of equals."""
    half = 0.0
    for k in range(count):
        half += 0.5 * weight[k]
    for k in range(count):
        below, upto = 0.0, 0.0
        own = matched[k, 0] + matched[k, 1] + matched[k, 2]
        for j in range(count):
            other = matched[j, 0] + matched[j, 1] + matched[j, 2]
            if other < own:
                below += weight[j]
            if other <= own:
                upto += weight[j]
        if below <= half and upto >= half:
            return k
    return 0


@numba.njit(cache=True, nogil=True)
def _agreed_colour(matched: np.ndarray, weight: np.ndarray, count: int, rgb: np.ndarray) -> None:
    """Mean of the samples that agree with the typical one, into `rgb`."""
    typical = _median_slot(matched, weight, count)
    total, sums = 0.0, np.zeros(3)
    for k in range(count):
        distance = 0.0
        for c in range(3):
            distance = max(distance, abs(matched[k, c] - matched[typical, c]))
        if distance <= AGREEMENT:
            w = weight[k] ** 2
            total += w
            for c in range(3):
                sums[c] += w * matched[k, c]
    for c in range(3):
        rgb[c] = np.uint8(min(max(sums[c] / total + 0.5, 0.0), 255.0))
