"""The z-buffer of points in plain torch: the law for the fast version, on any device.

Every offset of the largest disc is one scatter of all points: the smallest depth of each pixel
first, then the lowest index among the points at that depth.
"""

import torch
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor


def splat_points(
    pixels_uv: Shaped[Tensor, "points 2"],
    depth_m: Float[Tensor, " points"],
    radius_px: Int[Tensor, " points"],
    height_px: int,
    width_px: int,
) -> Int[Tensor, "height width"]:
    """Index of the nearest point in each pixel, or -1."""
    points = depth_m.shape[0]
    pixels = pixels_uv.floor().to(torch.int64)
    index = torch.arange(points, device=depth_m.device)
    is_seen = depth_m.isfinite() & (depth_m > 0)
    nearest_m = depth_m.new_full((height_px * width_px,), torch.inf)
    winner = index.new_full((height_px * width_px,), points)
    reach = int(radius_px.max()) if points else -1
    offsets = range(-reach, reach + 1)
    discs = [(du, dv) for dv in offsets for du in offsets]
    for du, dv in discs:
        cell, covers = _covered(pixels, radius_px, du, dv, height_px, width_px)
        used = covers & is_seen
        nearest_m.scatter_reduce_(0, cell[used], depth_m[used], "amin")
    for du, dv in discs:
        cell, covers = _covered(pixels, radius_px, du, dv, height_px, width_px)
        used = covers & is_seen
        used[used.clone()] = depth_m[used] == nearest_m[cell[used]]
        winner.scatter_reduce_(0, cell[used], index[used], "amin")
    winner[winner == points] = -1
    return winner.view(height_px, width_px)


def _covered(
    pixels_uv: Int[Tensor, "points 2"],
    radius_px: Int[Tensor, " points"],
    du: int,
    dv: int,
    height_px: int,
    width_px: int,
) -> tuple[Int[Tensor, " points"], Bool[Tensor, " points"]]:
    """The flat pixel at an offset from each point, and whether its disc covers that pixel."""
    u, v = pixels_uv[:, 0] + du, pixels_uv[:, 1] + dv
    inside = (u >= 0) & (u < width_px) & (v >= 0) & (v < height_px)
    within = du * du + dv * dv <= radius_px.to(torch.int64) * (radius_px + 1)
    return v * width_px + u, inside & within
