"""The blend of points on a surface on an NVIDIA GPU: one scatter over points, one division.

Pixels sum in whole multiples of 2^-38, which do not depend on the order of the points: equal input
gives equal bits. A sum may reach 3e7.
"""

import torch
import triton
from torch import Tensor

from lidarpainter_models.kernels.point_blend.triton_kernels import UNITS, scatter_shares

POINTS_AT_ONCE = 128


def blend_points(
    positions_uv: Tensor,
    depth_m: Tensor,
    attributes: Tensor,
    surface_depth_m: Tensor,
    weight: Tensor,
    radius_px: Tensor,
    tolerance: float,
) -> tuple[Tensor, Tensor]:
    """See `point_blend.blend_points`; computes in float32."""
    (height_px, width_px), channels = surface_depth_m.shape, attributes.shape[1]
    sums = torch.zeros(
        (height_px, width_px, channels + 1), dtype=torch.int64, device=depth_m.device
    )
    tensors = (positions_uv, depth_m, attributes, surface_depth_m, weight, radius_px)
    with torch.cuda.device_of(sums):
        if len(depth_m) and sums.numel():
            scatter_shares[(triton.cdiv(len(depth_m), POINTS_AT_ONCE),)](
                *(tensor.detach().float().contiguous() for tensor in tensors),
                sums,
                tolerance,
                len(depth_m),
                height_px,
                width_px,
                CHANNELS=channels,
                BLOCK=POINTS_AT_ONCE,
                num_warps=4,
            )
    totals = sums[..., -1:]
    means = torch.where(totals > 0, sums[..., :-1] / totals, 0.0)
    return means.float(), (totals[..., 0] / UNITS.value).float()
