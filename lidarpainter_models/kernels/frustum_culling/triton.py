"""Bounds of blocks of Gaussians, and which blocks cameras may see, on an NVIDIA GPU.

All views of a call share one launch and one copy to the device, of their planes and poses. Centres
and scales are read as float32.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from lidarpainter_models.kernels.frustum_culling import Blocks, Look, plane_rows
from lidarpainter_models.kernels.frustum_culling.triton_kernels import bound_blocks, mark_blocks
from lidarpainter_models.kernels.gpu_packages import dense_in_place


def refresh_bounds(
    blocks: Blocks, means: Tensor, log_scale: Tensor, is_stale: Tensor, reach_sigmas: float
) -> None:
    """See `frustum_culling.refresh_bounds`."""
    if len(blocks.body) == 0:
        return
    # a number among the arguments of a launch is a float32
    sigmas = torch.full((1,), reach_sigmas, dtype=torch.float64, device=means.device)
    bounds = (blocks.low, blocks.high, blocks.reach)
    with torch.cuda.device_of(means), dense_in_place(bounds) as dense:
        bound_blocks[(len(blocks.body),)](
            blocks.order.contiguous(),
            blocks.first.contiguous(),
            is_stale.contiguous(),
            means.float().contiguous(),
            log_scale.float().contiguous(),
            sigmas,
            *dense,
        )


def mark_seen(blocks: Blocks, views: Sequence[Look], is_seen: Tensor) -> None:
    """See `frustum_culling.mark_seen`."""
    if len(blocks.body) == 0 or len(views) == 0:
        return
    with torch.cuda.device_of(is_seen), dense_in_place((is_seen,)) as (dense,):
        mark_blocks[(len(blocks.body),)](
            blocks.order.contiguous(),
            blocks.first.contiguous(),
            blocks.body.contiguous(),
            blocks.low.contiguous(),
            blocks.high.contiguous(),
            blocks.reach.contiguous(),
            _told(views).to(is_seen.device, non_blocking=True),
            dense,
            len(views),
            len(views[0].camera_from_body),
        )


def _told(views: Sequence[Look]) -> Tensor:
    """Planes and slack of all views, then their poses: float64, where the poses lie."""
    numbers = [
        number
        for view in views
        for row in (*plane_rows(view.frustum), [view.frustum.actor_slack_m])
        for number in row
    ]
    poses = [view.camera_from_body.flatten() for view in views]
    planes = torch.tensor(numbers, dtype=torch.float64)
    return torch.cat([planes.to(poses[0].device, non_blocking=True), *poses])
