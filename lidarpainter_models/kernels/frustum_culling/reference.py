"""Bounds of blocks of Gaussians and the test of a view in plain torch: the law, on any device."""

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from lidarpainter_models.kernels.frustum_culling import Blocks, Look, plane_rows


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
    block, row = _of_ordered(blocks), blocks.order
    finite = is_finite[row][:, None]
    count = len(blocks.body)
    low = _of_each(block, torch.where(finite, means[row], torch.inf), count, "amin")
    high = _of_each(block, torch.where(finite, means[row], -torch.inf), count, "amax")
    size = torch.where(finite, largest[row][:, None], -torch.inf)
    reach = reach_sigmas * _of_each(block, size, count, "amax")[:, 0].double().exp()
    stale = is_stale[:, None]
    blocks.low.copy_(torch.where(stale, low.double(), blocks.low))
    blocks.high.copy_(torch.where(stale, high.double(), blocks.high))
    blocks.reach.copy_(torch.where(is_stale, reach, blocks.reach))


def mark_seen(blocks: Blocks, views: Sequence[Look], is_seen: Bool[Tensor, " gaussians"]) -> None:
    """See `frustum_culling.mark_seen`."""
    of_ordered = _of_ordered(blocks)
    for view in views:
        is_in_view = _is_in_view(blocks, view)
        is_seen |= torch.zeros_like(is_seen).index_copy(
            0, blocks.order, is_in_view.index_select(0, of_ordered)
        )


def _of_ordered(blocks: Blocks) -> Int[Tensor, " gaussians"]:
    """The block of each entry of `order`."""
    sizes = blocks.first[1:] - blocks.first[:-1]
    return torch.repeat_interleave(sizes, output_size=len(blocks.order))


def _is_in_view(blocks: Blocks, view: Look) -> Bool[Tensor, " blocks"]:
    """Whether blocks may hold a Gaussian that reaches into a view."""
    device, frustum = blocks.reach.device, view.frustum
    camera_from_body = view.camera_from_body.to(device, non_blocking=True)
    transform = camera_from_body[blocks.body.long()]
    reach = blocks.reach + torch.where(blocks.body > 0, frustum.actor_slack_m, 0.0)
    rows = torch.tensor(plane_rows(frustum), dtype=torch.float64)
    rows = rows.to(device, non_blocking=True)
    facing, stretch, begin = rows[:, :3], rows[:, 3], rows[:, 4]
    planes = facing @ transform[:, :3]
    middle, half = (blocks.low + blocks.high)[:, None] / 2, (blocks.high - blocks.low)[:, None] / 2
    slope = planes[..., :3]
    # of the corner of the box that is least outside
    outside = planes[..., 3] + (slope * middle - slope.abs() * half).sum(dim=2)
    reaches_in = outside + begin <= reach[:, None] * stretch
    return (blocks.low[:, 0] <= blocks.high[:, 0]) & reaches_in.all(dim=1)


def _of_each(
    block: Int[Tensor, " gaussians"],
    values: Float[Tensor, "gaussians columns"],
    count: int,
    which: str,
) -> Float[Tensor, "blocks columns"]:
    """The least or largest of each block; infinite where there is none."""
    bound = torch.inf if which == "amin" else -torch.inf
    out = values.new_full((count, values.shape[1]), bound)
    return out.scatter_reduce(0, block[:, None].expand_as(values), values, which)
