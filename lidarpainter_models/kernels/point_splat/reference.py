"""The z-buffer of points in plain torch: the law for the fast version, on any device.

Points are ranked by depth and index; the lowest rank wins a pixel. Each offset of the largest disc
is one scatter of the points whose disc reaches so far.
"""

import torch
from jaxtyping import Float, Int, Shaped
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
    nowhere = height_px * width_px
    by_depth = depth_m.argsort(stable=True)
    rank = torch.empty_like(by_depth)
    rank[by_depth] = torch.arange(points, device=rank.device)
    by_radius = radius_px.long().argsort(descending=True)
    column, row = pixels_uv.index_select(0, by_radius).floor().to(torch.int64).unbind(-1)
    depth_m, rank = depth_m.index_select(0, by_radius), rank.index_select(0, by_radius)
    is_seen = depth_m.isfinite() & (depth_m > 0)
    best = rank.new_full((nowhere + 1,), points)
    for (du, dv), count in _offsets(radius_px.index_select(0, by_radius)):
        u, v = column[:count] + du, row[:count] + dv
        inside = (u >= 0) & (u < width_px) & (v >= 0) & (v < height_px) & is_seen[:count]
        best.scatter_reduce_(
            0, torch.where(inside, v * width_px + u, nowhere), rank[:count], "amin"
        )
    beyond = by_depth.new_full((1,), -1)
    return torch.cat([by_depth, beyond])[best[:-1]].view(height_px, width_px)


def _offsets(descending_px: Int[Tensor, " points"]) -> list[tuple[tuple[int, int], int]]:
    """Offsets (columns, rows) within the largest disc, and how many points' discs hold each."""
    if len(descending_px) == 0:
        return []
    reach = int(descending_px[0])
    radii = torch.arange(reach + 1, device=descending_px.device)
    # ascending, as a search wants it
    smaller = torch.searchsorted(descending_px.long().flip(0), radii)
    of_radius = (len(descending_px) - smaller).tolist()
    sides = range(-reach, reach + 1)
    found = []
    for dv in sides:
        for du in sides:
            least = next((r for r in range(reach + 1) if du * du + dv * dv <= r * (r + 1)), None)
            if least is not None:
                found.append(((du, dv), of_radius[least]))
    return found
