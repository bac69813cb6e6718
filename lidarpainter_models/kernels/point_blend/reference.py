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
    nowhere = height_px * width_px
    surface = torch.cat([surface_depth_m.reshape(-1), surface_depth_m.new_zeros(1)])
    order = radius_px.argsort(descending=True)
    positions, depth, values, share, radius = (
        tensor.index_select(0, order)
        for tensor in (positions_uv, depth_m, attributes, weight, radius_px)
    )
    values = torch.cat([values, torch.ones_like(depth)[:, None]], dim=1)
    sums = values.new_zeros(nowhere + 1, values.shape[1])
    home = positions.floor()
    for (du, dv), count in _offsets(radius):
        u, v = home[:count, 0] + du, home[:count, 1] + dv
        across, down = u + 0.5 - positions[:count, 0], v + 0.5 - positions[:count, 1]
        distance_px = torch.hypot(across, down)
        inside = (u >= 0) & (u < width_px) & (v >= 0) & (v < height_px)
        pixel = torch.where(inside, v * width_px + u, nowhere).long()
        here = surface.index_select(0, pixel)
        met = (depth[:count] - here).abs() <= tolerance * here
        taken = (distance_px <= radius[:count]) & met & (here > 0)
        part = share[:count] * torch.exp(-2 * (distance_px / radius[:count]) ** 2)
        part = torch.where(taken, part, 0.0)[:, None] * values[:count]
        sums.index_add_(0, torch.where(taken, pixel, nowhere), part)
    totals = sums[:-1, -1]
    mean = torch.where(totals[:, None] > 0, sums[:-1, :-1] / totals[:, None], 0)
    return mean.reshape(height_px, width_px, -1), totals.reshape(height_px, width_px)


def _offsets(descending_px: Float[Tensor, " points"]) -> list[tuple[tuple[int, int], int]]:
    """Offsets (columns, rows) of pixels that discs can reach, and how many of the points do."""
    if len(descending_px) == 0:
        return []
    reach = math.ceil(float(descending_px[0]) + 1)
    sides = range(-reach, reach + 1)
    offsets = [(du, dv) for dv in sides for du in sides]
    # a point lies anywhere in its own pixel
    least = [math.hypot(max(abs(du) - 0.5, 0), max(abs(dv) - 0.5, 0)) for du, dv in offsets]
    least_px = torch.tensor(least, dtype=descending_px.dtype).to(descending_px.device)
    smaller = torch.searchsorted(descending_px.flip(0), least_px * (1 - 1e-6))
    counts = (len(descending_px) - smaller).tolist()
    return [(offset, count) for offset, count in zip(offsets, counts, strict=True) if count]
