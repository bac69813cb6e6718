"""Colour of a Gaussian seen from one direction: real spherical harmonics up to degree 3.

Order, signs and constants are those of Kerbl et al. (2023). Compiled code on eight Gaussians, whose
weights stand in flat arrays (`gaussian_lanes.lanes_at`).
"""

import numba
import numpy as np

from lidarpainter_models.kernels.gaussian_raster.compilation import EXACT
from lidarpainter_models.kernels.gaussian_raster.gaussian_lanes import in_all, lanes_at, set_lanes
from lidarpainter_models.kernels.gaussian_raster.small_vectors import Vector

BAND_0 = 0.28209479177387814
BAND_1 = 0.4886025119029199
BAND_2 = (1.0925484305920792, 0.31539156525252005, 0.5462742152960396)
BAND_3 = (
    0.5900435899266435,
    2.890611442640554,
    0.4570457994644658,
    0.3731763325901154,
    1.445305721320277,
)


@numba.njit(**EXACT)
def basis(coefficients: int, direction: Vector, out: np.ndarray) -> None:
    """Fill `out` with the first `coefficients` basis values at a unit direction."""
    x, y, z = direction
    set_lanes(out, 0, BAND_0)
    if coefficients > 1:
        set_lanes(out, 1, -BAND_1 * y)
        set_lanes(out, 2, BAND_1 * z)
        set_lanes(out, 3, -BAND_1 * x)
    if coefficients > 4:
        set_lanes(out, 4, BAND_2[0] * x * y)
        set_lanes(out, 5, -BAND_2[0] * y * z)
        set_lanes(out, 6, BAND_2[1] * (2.0 * z * z - x * x - y * y))
        set_lanes(out, 7, -BAND_2[0] * x * z)
        set_lanes(out, 8, BAND_2[2] * (x * x - y * y))
    if coefficients > 9:
        set_lanes(out, 9, -BAND_3[0] * y * (3.0 * x * x - y * y))
        set_lanes(out, 10, BAND_3[1] * x * y * z)
        set_lanes(out, 11, -BAND_3[2] * y * (4.0 * z * z - x * x - y * y))
        set_lanes(out, 12, BAND_3[3] * z * (2.0 * z * z - 3.0 * x * x - 3.0 * y * y))
        set_lanes(out, 13, -BAND_3[2] * x * (4.0 * z * z - x * x - y * y))
        set_lanes(out, 14, BAND_3[4] * z * (x * x - y * y))
        set_lanes(out, 15, -BAND_3[0] * x * (x * x - 3.0 * y * y))


@numba.njit(**EXACT)
def direction_gradient(coefficients: int, direction: Vector, weight: np.ndarray) -> Vector:
    """Gradient of sum_k weight[k] basis[k] with respect to the direction."""
    x, y, z = direction
    gx = gy = gz = in_all(0.0)
    if coefficients > 1:
        gx, gy, gz = (
            -BAND_1 * lanes_at(weight, 3),
            -BAND_1 * lanes_at(weight, 1),
            BAND_1 * lanes_at(weight, 2),
        )
    if coefficients > 4:
        w4, w5, w7 = (
            BAND_2[0] * lanes_at(weight, 4),
            -BAND_2[0] * lanes_at(weight, 5),
            -BAND_2[0] * lanes_at(weight, 7),
        )
        w6, w8 = 2.0 * BAND_2[1] * lanes_at(weight, 6), 2.0 * BAND_2[2] * lanes_at(weight, 8)
        gx += w4 * y - w6 * x + w7 * z + w8 * x
        gy += w4 * x + w5 * z - w6 * y - w8 * y
        gz += w5 * y + 2.0 * w6 * z + w7 * x
    if coefficients > 9:
        third = _band_3_gradient(direction, weight)
        gx, gy, gz = gx + third[0], gy + third[1], gz + third[2]
    return (gx, gy, gz)


@numba.njit(**EXACT)
def _band_3_gradient(direction: Vector, weight: np.ndarray) -> Vector:
    x, y, z = direction
    xx, yy, zz = x * x, y * y, z * z
    w9, w10, w11 = (
        -BAND_3[0] * lanes_at(weight, 9),
        BAND_3[1] * lanes_at(weight, 10),
        -BAND_3[2] * lanes_at(weight, 11),
    )
    w12, w13, w14 = (
        BAND_3[3] * lanes_at(weight, 12),
        -BAND_3[2] * lanes_at(weight, 13),
        BAND_3[4] * lanes_at(weight, 14),
    )
    w15 = -BAND_3[0] * lanes_at(weight, 15)
    gx = w9 * 6.0 * x * y + w10 * y * z - w11 * 2.0 * x * y - w12 * 6.0 * x * z
    gx += w13 * (4.0 * zz - 3.0 * xx - yy) + w14 * 2.0 * x * z + w15 * 3.0 * (xx - yy)
    gy = w9 * 3.0 * (xx - yy) + w10 * x * z + w11 * (4.0 * zz - xx - 3.0 * yy)
    gy -= w12 * 6.0 * y * z + w13 * 2.0 * x * y + w14 * 2.0 * y * z + w15 * 6.0 * x * y
    gz = w10 * x * y + w11 * 8.0 * y * z + w12 * (6.0 * zz - 3.0 * xx - 3.0 * yy)
    gz += w13 * 8.0 * x * z + w14 * (xx - yy)
    return (gx, gy, gz)
