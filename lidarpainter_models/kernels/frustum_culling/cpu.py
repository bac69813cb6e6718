"""Bounds of blocks of Gaussians, and which blocks a camera may see: compiled code."""

# ruff: noqa: ANN001, ANN202 - numba infers these types

import math
from collections.abc import Sequence

import numba
import numpy as np
from torch import Tensor

from lidarpainter_models.kernels.frustum_culling import Blocks, Look


def refresh_bounds(
    blocks: Blocks, means: Tensor, log_scale: Tensor, is_stale: Tensor, reach_sigmas: float
) -> None:
    """See `frustum_culling.refresh_bounds`."""
    _refresh_bounds(
        _arrays(blocks), is_stale.numpy(), means.numpy(), log_scale.numpy(), reach_sigmas
    )


def mark_seen(blocks: Blocks, views: Sequence[Look], is_seen: Tensor) -> None:
    """See `frustum_culling.mark_seen`."""
    for view in views:
        _mark_seen(_arrays(blocks), view.camera_from_body.numpy(), view.frustum, is_seen.numpy())


def _arrays(blocks: Blocks) -> Blocks:
    """Blocks as arrays; what is written to them is written to the blocks."""
    return Blocks._make(tensor.numpy() for tensor in blocks)


@numba.njit(cache=True, nogil=True)
def _refresh_bounds(blocks, is_stale, means, log_scale, reach_sigmas):
    """Bounds of the stale blocks; a Gaussian that is not finite is never drawn and has none."""
    for block in range(len(is_stale)):
        if not is_stale[block]:
            continue
        low, high = blocks.low[block], blocks.high[block]
        low[:], high[:] = np.inf, -np.inf
        largest = -np.inf
        for place in range(blocks.first[block], blocks.first[block + 1]):
            row = blocks.order[place]
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
        blocks.reach[block] = reach_sigmas * math.exp(largest)


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
def _mark_seen(blocks, camera_from_body, frustum, is_seen):
    """Mark the rows of all blocks in view."""
    for block in range(len(blocks.body)):
        transform = camera_from_body[blocks.body[block]]
        low, high, reach = blocks.low[block], blocks.high[block], blocks.reach[block]
        if blocks.body[block] > 0:
            reach += frustum.actor_slack_m
        if _is_in_view(low, high, reach, transform, frustum):
            for place in range(blocks.first[block], blocks.first[block + 1]):
                is_seen[blocks.order[place]] = True
