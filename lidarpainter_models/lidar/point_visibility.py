"""What a camera can see of a cloud of points: surfaces, what hides behind them, and edges.

All images of this module lie on a coarse grid over the camera's image; depth is camera z in
metres. A cloud is full of gaps between scan lines, so a plain z-buffer lets the background shine
through. A point counts as hidden when nearer surface stands on both sides of it, left and right
or above and below; a road seen at a grazing angle has nearer surface below it alone and stays.
Dark and glass bodies return few points: boxes of actors hide what lies behind them.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from lidarpainter_models.geometry.box_masks import box_outlines
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.kernels.point_splat import splat_points

_FAR_M = 1e6
EDGE_TOLERANCE = 0.15  # a neighbour nearer or further by this share of the depth makes an edge
GAP_RAD = 0.012  # gaps between scan lines up to this angle are closed to the background
HIDDEN_TOLERANCE = 0.05  # a point is behind a surface when further by this share of its depth
EDGE_RAD = 0.004  # nearer surface within this angle spoils a sample: errors of pose and calibration
RIM_RAD = 0.008  # a surface that ends within this angle may show what is beyond it


@dataclass(frozen=True, kw_only=True, eq=False)
class Visibility:
    """What stands before and around each cell of the grid."""

    hidden_from_m: Float[Tensor, "rows columns"]
    """Beyond this depth a point has nearer surface on both sides."""
    nearest_m: Float[Tensor, "rows columns"]
    """Nearest surface in the neighbourhood."""
    furthest_m: Float[Tensor, "rows columns"]
    """Furthest surface in the neighbourhood, very far where part of it is open."""
    box_m: Float[Tensor, "rows columns"]
    """Far end of the nearest actor box that covers the cell."""
    inner_m: Float[Tensor, "rows columns"]
    """Depth of the surface where it goes on all around the cell, 0 at its rims and beyond."""


def surface_visibility(
    cells_uv: Int[Tensor, "points 2"],
    depth_m: Float[Tensor, " points"],
    radius_px: Int[Tensor, " points"],
    grid: Camera,
    box_m: Float[Tensor, "rows columns"],
) -> Visibility:
    """What a cloud of discs and boxes lets a camera see.

    The cells are pixels of `grid`; `box_m` is as `box_far_ends` gives it.
    """
    gap_px, edge_px, rim_px = (
        max(1, round(angle_rad * grid.fx_px)) for angle_rad in (GAP_RAD, EDGE_RAD, RIM_RAD)
    )
    seen = splat_points(
        cells_uv, depth_m, height_px=grid.height_px, width_px=grid.width_px, radius_px=radius_px
    )
    is_surface = (seen >= 0).numpy()
    depth = np.append(depth_m.numpy(), np.float32(_FAR_M))[seen.numpy()]  # -1 is the last
    steps = ((1, 0), (-1, 0), (0, 1), (0, -1))
    sides = [_nearest_towards(depth, gap_px, *step) for step in steps]
    hidden = np.minimum(np.maximum(sides[0], sides[1]), np.maximum(sides[2], sides[3]))
    square = np.ones((2 * edge_px + 1,) * 2, np.uint8)
    nearest = cv2.erode(depth, square, borderType=cv2.BORDER_REPLICATE)
    wide = np.ones((2 * rim_px + 1,) * 2, np.uint8)
    known = np.where(is_surface, depth, np.float32(0))
    furthest = cv2.dilate(known, wide, borderType=cv2.BORDER_REPLICATE)
    gaps = np.ones((2 * gap_px + 1,) * 2, np.uint8)
    closed = cv2.morphologyEx(is_surface.astype(np.uint8), cv2.MORPH_CLOSE, gaps)
    is_closed = cv2.erode(closed, wide) > 0
    is_inner = is_surface & is_closed & (nearest >= depth * (1 - EDGE_TOLERANCE))
    is_inner &= furthest <= depth * (1 + EDGE_TOLERANCE)
    return Visibility(
        hidden_from_m=torch.from_numpy(hidden),
        nearest_m=torch.from_numpy(nearest),
        furthest_m=torch.from_numpy(np.where(is_closed, furthest, np.float32(_FAR_M))),
        box_m=box_m,
        inner_m=torch.from_numpy(np.where(is_inner, depth, np.float32(0))),
    )


def box_far_ends(
    boxes: Sequence[tuple[Float[Tensor, "4 4"], Float[Tensor, "3"]]], camera: Camera
) -> Float[Tensor, "rows columns"]:
    """Depth of the far end of the nearest box over each pixel, very far where there is none.

    Each box is `world_from_box` and its size; the camera's pixels are the cells.
    """
    far_ends = np.full((camera.height_px, camera.width_px), _FAR_M, np.float32)
    if boxes:
        poses, sizes_m = map(torch.stack, zip(*boxes, strict=True))
        outlines = box_outlines(camera, poses, sizes_m)
        # the nearest is drawn last, over all that end behind it
        for outline in sorted(outlines, key=lambda outline: outline.far_m, reverse=True):
            cv2.fillConvexPoly(far_ends, outline.hull, outline.far_m)
    return torch.from_numpy(far_ends)


def visible_points(
    cells_uv: Int[Tensor, "points 2"], depth_m: Float[Tensor, " points"], visibility: Visibility
) -> Bool[Tensor, " points"]:
    """Whether nothing known stands before each point."""
    column, row = cells_uv.long().unbind(-1)
    is_open = depth_m * (1 - HIDDEN_TOLERANCE) <= visibility.hidden_from_m[row, column]
    return is_open & (depth_m <= visibility.box_m[row, column])


def _nearest_towards(depth_m: np.ndarray, reach_px: int, step_u: int, step_v: int) -> np.ndarray:
    """Smallest depth in the cell and up to `reach_px` from it in one direction."""
    shape = (1, reach_px + 1) if step_u else (reach_px + 1, 1)
    end = 0 if step_u + step_v > 0 else reach_px
    anchor = (end, 0) if step_u else (0, end)
    return cv2.erode(
        depth_m,
        np.ones(shape, np.uint8),
        anchor=anchor,
        borderType=cv2.BORDER_CONSTANT,
        borderValue=_FAR_M,
    )
