# ruff: noqa: ANN001, ANN201, ANN202 - numba infers these types
"""Bounds of blocks of Gaussians, and which blocks a camera may see: compiled code."""

import math
from typing import NamedTuple

import numba
import numpy as np


class Bounds(NamedTuple):
    """What the Gaussians of each block keep to, in the frame of its body, metres."""

    low: np.ndarray
    """(blocks, 3): of the centres."""
    high: np.ndarray
    """(blocks, 3): under `low` where no Gaussian of the block is finite."""
    reach: np.ndarray
    """(blocks): the farthest that any may reach from its centre."""


class Frustum(NamedTuple):
    """A pinhole camera's view; of two numbers the first is horizontal, the second vertical."""

    lowest: tuple[float, float]
    """Tangents x/z and y/z of the image's left and top edge."""
    highest: tuple[float, float]
    stretch: tuple[float, float]
    """Most that the linearised projection stretches a Gaussian across the ray."""
    near_m: float
    actor_slack: tuple[float, float]
    """How far the actors' boxes may still move before they are drawn: metres, radians."""


@numba.njit(cache=True)
def refresh_bounds(order, first, is_stale, means, log_scale, reach_sigmas, bounds):
    """Bounds of the stale blocks; a Gaussian that is not finite is never drawn and has none."""
    for block in range(len(is_stale)):
        if not is_stale[block]:
            continue
        low, high = bounds.low[block], bounds.high[block]
        low[:], high[:] = np.inf, -np.inf
        largest = -np.inf
        for place in range(first[block], first[block + 1]):
            row = order[place]
            size = max(log_scale[row, 0], log_scale[row, 1], log_scale[row, 2])
            if not math.isfinite(means[row, 0] + means[row, 1] + means[row, 2] + size):
                continue
            largest = max(largest, size)
            for axis in range(3):
                low[axis] = min(low[axis], means[row, axis])
                high[axis] = max(high[axis], means[row, axis])
        bounds.reach[block] = reach_sigmas * math.exp(largest)


@numba.njit(cache=True)
def _is_in_view(low, high, reach, transform, frustum):
    """Whether a box of centres may hold a Gaussian that reaches into the view."""
    if not low[0] <= high[0]:
        return False
    z, z_half = transform[2, 3], 0.0
    for k in range(3):
        z += transform[2, k] * 0.5 * (low[k] + high[k])
        z_half += abs(transform[2, k]) * 0.5 * (high[k] - low[k])
    if z + z_half + reach < frustum.near_m:
        return False
    for axis in range(2):
        for side in range(2):
            tangent = frustum.highest[axis] if side else -frustum.lowest[axis]
            sign = 1.0 if side else -1.0
            # outside where sign x - tangent z is larger than the Gaussian reaches
            outside = sign * transform[axis, 3] - tangent * transform[2, 3]
            for k in range(3):
                slope = sign * transform[axis, k] - tangent * transform[2, k]
                outside += slope * 0.5 * (low[k] + high[k]) - abs(slope) * 0.5 * (high[k] - low[k])
            if outside > reach * frustum.stretch[axis]:
                return False
    return True


@numba.njit(cache=True)
def mark_seen(order, first, body, bounds, camera_from_body, frustum, is_seen):
    """Mark the rows of all blocks in view."""
    for block in range(len(body)):
        transform = camera_from_body[body[block]]
        low, high, reach = bounds.low[block], bounds.high[block], bounds.reach[block]
        if body[block] > 0:
            lever = max(abs(low[0]), abs(high[0])) + max(abs(low[1]), abs(high[1]))
            lever += max(abs(low[2]), abs(high[2]))
            reach += frustum.actor_slack[0] + frustum.actor_slack[1] * lever
        if _is_in_view(low, high, reach, transform, frustum):
            for place in range(first[block], first[block + 1]):
                is_seen[order[place]] = True
