"""The z-buffer of points on an NVIDIA GPU: all claim their discs, the least key keeps a pixel.

A key holds the depth's bits above the point's index; positive floats sort as their bits do. A
minimum does not depend on the order of the points, so equal input gives equal bits.
"""

import torch
import triton
from torch import Tensor

from lidarpainter_models.kernels.point_splat import reference
from lidarpainter_models.kernels.point_splat.triton_kernels import claim_discs

POINTS_AT_ONCE = 128
_FREE = torch.iinfo(torch.int64).max


def splat_points(
    pixels_uv: Tensor, depth_m: Tensor, radius_px: Tensor, height_px: int, width_px: int
) -> Tensor:
    """See `point_splat.splat_points`; depths other than float32 are left to the reference."""
    if depth_m.dtype != torch.float32:
        return reference.splat_points(pixels_uv, depth_m, radius_px, height_px, width_px)
    keys = torch.full((height_px, width_px), _FREE, dtype=torch.int64, device=depth_m.device)
    with torch.cuda.device_of(keys):
        if len(depth_m) and keys.numel():
            claim_discs[(triton.cdiv(len(depth_m), POINTS_AT_ONCE),)](
                pixels_uv.floor().to(torch.float32).contiguous(),
                depth_m.contiguous(),
                radius_px.to(torch.int32).contiguous(),
                keys,
                len(depth_m),
                height_px,
                width_px,
                BLOCK=POINTS_AT_ONCE,
                num_warps=4,
            )
    return torch.where(keys == _FREE, -1, keys & 0xFFFFFFFF)
