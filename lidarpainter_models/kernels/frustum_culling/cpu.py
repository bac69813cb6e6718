"""Bounds of blocks of Gaussians, and which blocks a camera may see: compiled code."""

# ruff: noqa: ANN001, ANN202 - numba infers these types

import math
from collections.abc import Sequence
from typing import NamedTuple

import numba
import numpy as np
from torch import Tensor

from lidarpainter_models.kernels.frustum_culling.blocks import Blocks, Look


def refresh_bounds(
    blocks: Blocks, means: Tensor, log_scale: Tensor, is_stale: Tensor, reach_sigmas: float
) -> None:
    """See `frustum_culling.refresh_bounds`."""
    _refresh_bounds(
        blocks.order.numpy(),
        blocks.first.numpy(),
        is_stale.numpy(),
        means.numpy(),
        log_scale.numpy(),
        reach_sigmas,
        _bounds(blocks),
    )


def mark_seen(blocks: Blocks, views: Sequence[Look], is_seen: Tensor) -> None:
    """See `frustum_culling.mark_seen`."""
    for view in views:
        _mark_seen(
            blocks.order.numpy(),
            blocks.first.numpy(),
            blocks.body.numpy(),
            _bounds(blocks),
            view.camera_from_body.numpy(),
            view.frustum,
            is_seen.numpy(),
        )


class _Bounds(NamedTuple):
    low: np.ndarray
    high: np.ndarray
    reach: np.ndarray


def _bounds(blocks: Blocks) -> _Bounds:
    """The arrays of the bounds; what is written to them is written to the blocks."""
    return _Bounds(blocks.low.numpy(), blocks.high.numpy(), blocks.reach.numpy())


@numba.njit(cache=True, nogil=True)
def _refresh_bounds(order, first, is_stale, means, log_scale, reach_sigmas, bounds):
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
            # a maximum may pass over what is no number
            scales = log_scale[row, 0] + log_scale[row, 1] + log_scale[row, 2]
            place_and_size = means[row, 0] + means[row, 1] + means[row, 2] + size
            if math.isnan(scales) or not math.isfinite(place_and_size):
                continue
            largest = max(largest, size)
            for axis in range(3):
                low[axis] = min(low[axis], means[row, axis])
                high[axis] = max(high[axis], means[row, axis])
        bounds.reach[block] = reach_sigmas * math.exp(largest)


@numba.njit(cache=True, nogil=True)
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


@numba.njit(cache=True, nogil=True)
def _mark_seen(order, first, body, bounds, camera_from_body, frustum, is_seen):
    """Mark the rows of all blocks in view."""
    for block in range(len(body)):
        transform = camera_from_body[body[block]]
        low, high, reach = bounds.low[block], bounds.high[block], bounds.reach[block]
        if body[block] > 0:
            reach += frustum.actor_slack_m
        if _is_in_view(low, high, reach, transform, frustum):
            for place in range(first[block], first[block + 1]):
                is_seen[order[place]] = True
