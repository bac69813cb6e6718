"""The exponential of the blending loops, in a form that compilers turn into vector code."""

import numba
import numpy as np

from lidarpainter_models.kernels.gaussian_raster.compilation import EXACT

EIGHTH = np.float32(0.125)
# minimax in relative error over the exponents that survive the alpha cut, divided by eight
C0 = np.float32(0.99999994)
C1 = np.float32(0.99999183)
C2 = np.float32(0.49987432)
C3 = np.float32(0.16593865)
C4 = np.float32(0.03971106)
C5 = np.float32(0.0058094156)


@numba.njit(**EXACT)
def lane_exp(x: np.float32) -> np.float32:
    """exp(x) for -5.7 <= x <= 0, float32: a polynomial on x/8, squared three times."""
    y = x * EIGHTH
    value = ((((C5 * y + C4) * y + C3) * y + C2) * y + C1) * y + C0
    value *= value
    value *= value
    value *= value
    return value
