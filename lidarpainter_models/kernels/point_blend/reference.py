"""The plain blend of points on a surface: one pass of tensor code per pixel offset, any device."""

import math

import torch
from jaxtyping import Float
from torch import Tensor


def blend_points(
    positions_uv: Float[Tensor, "points 2"],
    depth_m: Float[Tensor, " points"],
    attributes: Float[Tensor, "points channels"],
    surface_depth_m: Float[Tensor, "height width"],
    weight: Float[Tensor, " points"],
    radius_px: Float[Tensor, " points"],
    tolerance: float,
) -> tuple[Float[Tensor, "height width channels"], Float[Tensor, "height width"]]:
    """See `point_blend.blend_points`."""
    height_px, width_px = surface_depth_m.shape
    surface = surface_depth_m.reshape(-1)
    sums = attributes.new_zeros(height_px * width_px, attributes.shape[1])
    totals = attributes.new_zeros(height_px * width_px)
    home = positions_uv.floor()
    reach_px = math.ceil(float(radius_px.max()) + 1) if len(depth_m) else 0
    for shift_v in range(-reach_px, reach_px + 1):
        for shift_u in range(-reach_px, reach_px + 1):
            shift = home.new_tensor([shift_u, shift_v])
            column, row = (home + shift).long().unbind(-1)
            distance_px = (home + shift + 0.5 - positions_uv).norm(dim=-1)
            inside = (column >= 0) & (column < width_px) & (row >= 0) & (row < height_px)
            pixel = torch.where(inside, row * width_px + column, 0)
            met = (depth_m - surface[pixel]).abs() <= tolerance * surface[pixel]
            taken = inside & (distance_px <= radius_px) & met & (surface[pixel] > 0)
            share = weight * torch.exp(-2 * (distance_px / radius_px) ** 2)
            sums.index_add_(0, pixel[taken], (share[:, None] * attributes)[taken])
            totals.index_add_(0, pixel[taken], share[taken])
    mean = torch.where(totals[:, None] > 0, sums / totals[:, None], 0)
    return mean.reshape(height_px, width_px, -1), totals.reshape(height_px, width_px)
