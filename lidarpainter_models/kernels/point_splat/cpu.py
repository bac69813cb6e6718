"""The z-buffer of points with numba: each thread owns a band of rows and visits all points.

Points are visited in ascending order and only a strictly nearer one replaces another, so ties go
to the lower index and the number of threads changes nothing.
"""

import numba
import numpy as np
import torch
from torch import Tensor


def splat_points(
    pixels_uv: Tensor, depth_m: Tensor, radius_px: Tensor, height_px: int, width_px: int
) -> Tensor:
    """Index of the nearest point in each pixel, or -1."""
    winner = _splat(
        pixels_uv.to(torch.int64).contiguous().numpy(),
        depth_m.contiguous().numpy(),
        radius_px.to(torch.int64).contiguous().numpy(),
        height_px,
        width_px,
        numba.get_num_threads(),
    )
    return torch.from_numpy(winner)


@numba.njit(cache=True, parallel=True)
def _splat(
    pixels_uv: np.ndarray,
    depth_m: np.ndarray,
    radius_px: np.ndarray,
    height_px: int,
    width_px: int,
    num_bands: int,
) -> np.ndarray:
    winner = np.full((height_px, width_px), -1, dtype=np.int64)
    nearest_m = np.full((height_px, width_px), np.inf, dtype=depth_m.dtype)
    for band in numba.prange(num_bands):
        start, stop = band * height_px // num_bands, (band + 1) * height_px // num_bands
        for point in range(depth_m.shape[0]):
            z = depth_m[point]
            if not (0 < z < np.inf):
                continue
            u, v, r = pixels_uv[point, 0], pixels_uv[point, 1], radius_px[point]
            limit = r * (r + 1)
            for row in range(max(v - r, start), min(v + r + 1, stop)):
                rest = limit - (row - v) * (row - v)
                for column in range(max(u - r, 0), min(u + r + 1, width_px)):
                    if (column - u) * (column - u) <= rest and z < nearest_m[row, column]:
                        nearest_m[row, column] = z
                        winner[row, column] = point
    return winner
