"""Bounds of blocks of Gaussians and the test of a view in plain torch: the law, on any device."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from lidarpainter_models.kernels.frustum_culling.blocks import Blocks, Frustum


def refresh_bounds(
    blocks: Blocks,
    means: Float[Tensor, "gaussians 3"],
    log_scale: Float[Tensor, "gaussians 3"],
    is_stale: Bool[Tensor, " blocks"],
    reach_sigmas: float,
) -> None:
    """See `frustum_culling.refresh_bounds`."""
    largest = log_scale.amax(dim=1)
    is_finite = (means.sum(dim=1) + largest).isfinite()
    for block in is_stale.nonzero()[:, 0].tolist():
        rows = blocks.order[blocks.first[block] : blocks.first[block + 1]]
        rows = rows[is_finite[rows]]
        nothing = means.new_full((1, 3), torch.inf)
        blocks.low[block] = torch.cat([means[rows], nothing]).amin(dim=0)
        blocks.high[block] = torch.cat([means[rows], -nothing]).amax(dim=0)
        sizes = torch.cat([largest[rows].double(), largest.new_full((1,), -torch.inf).double()])
        blocks.reach[block] = reach_sigmas * sizes.amax().exp()


def mark_seen(
    blocks: Blocks,
    camera_from_body: Float[Tensor, "bodies 4 4"],
    frustum: Frustum,
    is_seen: Bool[Tensor, " gaussians"],
) -> None:
    """See `frustum_culling.mark_seen`."""
    transform = camera_from_body[blocks.body.long()]
    lever = torch.maximum(blocks.low.abs(), blocks.high.abs()).sum(dim=1)
    slack = frustum.actor_slack[0] + frustum.actor_slack[1] * lever
    reach = blocks.reach + torch.where(blocks.body > 0, slack, 0.0)
    is_in_view = (blocks.low[:, 0] <= blocks.high[:, 0]) & (
        _farthest(transform[:, 2], blocks) + reach >= frustum.near_m
    )
    for axis in range(2):
        for tangent, sign in ((frustum.lowest[axis], -1.0), (frustum.highest[axis], 1.0)):
            # a plane through the camera: outside it is sign (x - tangent z) > 0
            plane = sign * (transform[:, axis] - tangent * transform[:, 2])
            is_in_view &= ~(-_farthest(-plane, blocks) > reach * frustum.stretch[axis])
    sizes = blocks.first[1:] - blocks.first[:-1]
    is_seen[blocks.order[torch.repeat_interleave(is_in_view, sizes)]] = True


def _farthest(plane: Float[Tensor, "blocks 4"], blocks: Blocks) -> Float[Tensor, " blocks"]:
    """Largest value of a linear function on each block's box of centres."""
    middle, half = (blocks.low + blocks.high) / 2, (blocks.high - blocks.low) / 2
    slope = plane[:, :3]
    return plane[:, 3] + (slope * middle).sum(dim=1) + (slope.abs() * half).sum(dim=1)
