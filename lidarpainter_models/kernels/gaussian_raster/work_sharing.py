"""Share out uneven work evenly: threads take contiguous places, places jump through the work.

Sky tiles are empty and road tiles are full, near Gaussians reach many tiles and far ones few, so
contiguous shares of tiles or Gaussians would keep one thread waiting for another.
"""

import math

import numba

from lidarpainter_models.kernels.gaussian_raster.compilation import EXACT

GOLDEN_RATIO = 0.6180339887498949
"""Multiples of it, modulo 1, fill an interval most evenly."""


@numba.njit(**EXACT)
def jump_of(count: int) -> int:
    """A step near the golden ratio of `count` that visits all of `range(count)`, modulo `count`."""
    jump = max(int(count * GOLDEN_RATIO), 1)
    while math.gcd(jump, count) > 1:
        jump += 1
    return jump
