"""The blend of points on a surface, compiled by numba: one scatter over points, one division."""

# ruff: noqa: ANN001, ANN202, PLR0913 -- numba infers its own types and takes flat arrays

import numba
import numpy as np
import torch
from torch import Tensor


def _gaussian_terms() -> tuple[np.float32, ...]:
    """Coefficients of the polynomial in y = d^2 / r^2 that is exp(-2 y) on [0, 1] to 3e-7."""
    fitted = np.polynomial.Chebyshev.interpolate(lambda y: np.exp(-2 * y), 8, domain=[0, 1])
    return tuple(np.float32(term) for term in fitted.convert(kind=np.polynomial.Polynomial).coef)


_C0, _C1, _C2, _C3, _C4, _C5, _C6, _C7, _C8 = _gaussian_terms()


@numba.njit(cache=True, nogil=True, inline="always")
def _gaussian(y):
    high = _C4 + y * (_C5 + y * (_C6 + y * (_C7 + y * _C8)))
    return _C0 + y * (_C1 + y * (_C2 + y * (_C3 + y * high)))


@numba.njit(cache=True, nogil=True)
def _scatter(uv, depth, attributes, surface, weight, radius, tolerance, sums, totals):
    height, width = surface.shape
    channels = attributes.shape[1]
    for point in range(depth.shape[0]):
        u, v, z, r = uv[point, 0], uv[point, 1], depth[point], radius[point]
        if not z < np.inf:
            continue
        inverse = np.float32(1.0) / (r * r)
        first_row, last_row = max(0, int(np.floor(v - r))), min(height - 1, int(np.floor(v + r)))
        first_col, last_col = max(0, int(np.floor(u - r))), min(width - 1, int(np.floor(u + r)))
        for row in range(first_row, last_row + 1):
            dv = np.float32(row) + np.float32(0.5) - v
            for col in range(first_col, last_col + 1):
                s = surface[row, col]
                if s <= 0 or abs(z - s) > tolerance * s:
                    continue
                du = np.float32(col) + np.float32(0.5) - u
                square = du * du + dv * dv
                if square > r * r:
                    continue
                share = weight[point] * _gaussian(inverse * square)
                totals[row, col] += share
                for channel in range(channels):
                    sums[row, col, channel] += share * attributes[point, channel]


@numba.njit(cache=True, nogil=True)
def _divide(sums, totals):
    for row in range(totals.shape[0]):
        for col in range(totals.shape[1]):
            total = totals[row, col]
            if total > 0:
                for channel in range(sums.shape[2]):
                    sums[row, col, channel] /= total


def _array(tensor: Tensor) -> np.ndarray:
    return np.ascontiguousarray(tensor.detach().numpy(), np.float32)


def blend_points(
    positions_uv: Tensor,
    depth_m: Tensor,
    attributes: Tensor,
    surface_depth_m: Tensor,
    weight: Tensor,
    radius_px: Tensor,
    tolerance: float,
) -> tuple[Tensor, Tensor]:
    """See `point_blend.blend_points`; computes in float32."""
    height_px, width_px = surface_depth_m.shape
    sums = np.zeros((height_px, width_px, attributes.shape[1]), np.float32)
    totals = np.zeros((height_px, width_px), np.float32)
    _scatter(
        _array(positions_uv),
        _array(depth_m),
        _array(attributes),
        _array(surface_depth_m),
        _array(weight),
        _array(radius_px),
        np.float32(tolerance),
        sums,
        totals,
    )
    _divide(sums, totals)
    return torch.from_numpy(sums), torch.from_numpy(totals)
