"""Surfaces of splatted points in an image: what they hide, and the gaps in them.

Depth is camera z in metres. A surface holds infinity, a depth image 0, where there is nothing.
"""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from lidarpainter_models.kernels.point_splat import splat_points

DIRECTIONS = ((0, 1), (0, -1), (1, 0), (-1, 0), (1, 1), (1, -1), (-1, 1), (-1, -1))
"""The 8 directions around a pixel, as steps in (rows, columns)."""


def disc_surface(
    positions_uv: Float[Tensor, "points 2"],
    depth_m: Float[Tensor, " points"],
    radius_px: Int[Tensor, " points"] | int,
    *,
    height_px: int,
    width_px: int,
) -> Float[Tensor, "height width"]:
    """Depth of the nearest disc in each pixel, infinity where there is none."""
    nearest = splat_points(
        positions_uv,
        depth_m,
        height_px=height_px,
        width_px=width_px,
        radius_px=radius_px,
    ).to(torch.int64)
    beyond = depth_m.new_full((1,), torch.inf)
    return torch.cat([depth_m, beyond])[nearest]  # index -1 takes infinity


def curtain(surface: Float[Tensor, "height width"], reach_px: int) -> Float[Tensor, "height width"]:
    """The depth beyond which each of the 8 directions meets nearer surface.

    A direction is a wedge, not a ray: beyond its first pixel it is three pixels wide, so that it
    does not slip between the points of a sparse surface.
    """
    height_px, width_px = surface.shape
    wide = -torch.nn.functional.max_pool2d(-surface[None], 3, 1, 1)[0]
    narrow = torch.nn.functional.pad(surface, [reach_px] * 4, value=torch.inf)
    wide = torch.nn.functional.pad(wide, [reach_px] * 4, value=torch.inf)
    behind = torch.zeros_like(surface)
    for step_v, step_u in DIRECTIONS:
        best = torch.full_like(surface, torch.inf)
        for step in range(1, reach_px + 1):
            top, left = reach_px + step * step_v, reach_px + step * step_u
            layer = narrow if step == 1 else wide
            torch.minimum(best, layer[top : top + height_px, left : left + width_px], out=best)
        torch.maximum(behind, best, out=behind)
    return behind


def surface_gaps(
    depth_m: Float[Tensor, "height width"],
    reach_px: int,
    num_directions: int,
    *,
    depth_range: float,
) -> Bool[Tensor, "height width"]:
    """Pixels without depth that one surface surrounds.

    In `num_directions` of the 8 directions a pixel with depth is met within reach, and all depths
    met differ by at most the share `depth_range`.
    """
    row, column = ((depth_m == 0) & spread(depth_m > 0, reach_px)).nonzero().unbind(-1)
    padded = torch.nn.functional.pad(depth_m, [reach_px] * 4).reshape(-1)
    row_px = depth_m.shape[1] + 2 * reach_px
    place = (row + reach_px) * row_px + column + reach_px
    met = []
    for step_v, step_u in DIRECTIONS:
        first = torch.zeros_like(depth_m[row, column])
        for step in range(reach_px, 0, -1):
            here = padded[place + step * (step_v * row_px + step_u)]
            first = torch.where(here > 0, here, first)
        met.append(first)
    ascending = torch.stack(met).sort(dim=0).values
    near, far = ascending[len(DIRECTIONS) - num_directions], ascending[-1]
    gaps = torch.zeros_like(depth_m, dtype=torch.bool)
    gaps[row, column] = (near > 0) & (far <= near * (1 + depth_range))
    return gaps


def spread(mask: Bool[Tensor, "height width"], reach_px: int) -> Bool[Tensor, "height width"]:
    """Pixels with a marked one in the square around them."""
    pool = torch.nn.functional.max_pool2d
    side_px = 2 * reach_px + 1
    along_rows = pool(mask.float()[None], (1, side_px), 1, (0, reach_px))
    return pool(along_rows, (side_px, 1), 1, (reach_px, 0))[0] > 0
