"""Real spherical harmonics up to degree 3 and their slopes (constants of Kerbl et al. 2023)."""

import triton
import triton.language as tl

from lidarpainter_models.kernels.gaussian_raster import spherical_harmonics as numba_harmonics

BAND_0 = tl.constexpr(numba_harmonics.BAND_0)
BAND_1 = tl.constexpr(numba_harmonics.BAND_1)
A2, B2, C2 = (tl.constexpr(number) for number in numba_harmonics.BAND_2)
A3, B3, C3, D3, E3 = (tl.constexpr(number) for number in numba_harmonics.BAND_3)


@triton.jit
def basis(x, y, z):
    """The sixteen basis values at unit directions; what is not used is not computed."""
    xx, yy, zz = x * x, y * y, z * z
    return (
        0.0 * x + BAND_0,
        y * (-BAND_1),
        z * BAND_1,
        x * (-BAND_1),
        x * y * A2,
        y * z * (-A2),
        (2.0 * zz - xx - yy) * B2,
        x * z * (-A2),
        (xx - yy) * C2,
        y * (3.0 * xx - yy) * (-A3),
        x * y * z * B3,
        y * (4.0 * zz - xx - yy) * (-C3),
        z * (2.0 * zz - 3.0 * xx - 3.0 * yy) * D3,
        x * (4.0 * zz - xx - yy) * (-C3),
        z * (xx - yy) * E3,
        x * (xx - 3.0 * yy) * (-A3),
    )


@triton.jit
def slopes(x, y, z):
    """How the basis values change with x, with y and with z."""
    xx, yy, zz, none = x * x, y * y, z * z, 0.0 * x
    along_x = (
        none,
        none,
        none,
        none - BAND_1,
        y * A2,
        none,
        x * (-2.0 * B2),
        z * (-A2),
        x * (2.0 * C2),
        x * y * (-6.0 * A3),
        y * z * B3,
        x * y * (2.0 * C3),
        x * z * (-6.0 * D3),
        (4.0 * zz - 3.0 * xx - yy) * (-C3),
        x * z * (2.0 * E3),
        (xx - yy) * (-3.0 * A3),
    )
    along_y = (
        none,
        none - BAND_1,
        none,
        none,
        x * A2,
        z * (-A2),
        y * (-2.0 * B2),
        none,
        y * (-2.0 * C2),
        (xx - yy) * (-3.0 * A3),
        x * z * B3,
        (4.0 * zz - xx - 3.0 * yy) * (-C3),
        y * z * (-6.0 * D3),
        x * y * (2.0 * C3),
        y * z * (-2.0 * E3),
        x * y * (6.0 * A3),
    )
    along_z = (
        none,
        none,
        none + BAND_1,
        none,
        none,
        y * (-A2),
        z * (4.0 * B2),
        x * (-A2),
        none,
        none,
        x * y * B3,
        y * z * (-8.0 * C3),
        (6.0 * zz - 3.0 * xx - 3.0 * yy) * D3,
        x * z * (-8.0 * C3),
        (xx - yy) * E3,
        none,
    )
    return along_x, along_y, along_z
