"""Colours at the rims of surfaces, where a small error of pose shows what is beside them."""

import cv2
import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from lidarpainter_models.kernels.colour_sampling import sample_levels, steps_inside
from lidarpainter_models.lidar.point_visibility import Visibility
from lidarpainter_models.lidar.points_in_view import CellGrid, PointsInView

EDGE_TOLERANCE = 0.15  # a neighbour nearer or further by this share of the depth makes an edge
BEHIND_EDGE_WEIGHT = 0.2  # weight of a sample beside a nearer surface
RIM_WEIGHT = 0.4  # weight of a sample on the rim of a surface
FOREIGN_LIKENESS = 30.0
"""A rim's colour is foreign when nearer than this (RGB distance of 255) to that beyond..."""
FOREIGN_CONTRAST = 60.0
"""... and further than this from that inside."""
INNER_REACH = 6  # how many cells away the inner part of a surface is looked for from its rim


class ImageLevels:
    """An image at three sizes, and at which of them each point is sampled."""

    def __init__(
        self, image: UInt8[Tensor, "height width 3"], footprint_px: Float[Tensor, " points"]
    ) -> None:
        height_px, width_px = image.shape[:2]
        self._images = [image.numpy()]
        for shrink in (2, 4):
            size = (max(1, width_px // shrink), max(1, height_px // shrink))
            self._images.append(cv2.resize(image.numpy(), size, interpolation=cv2.INTER_AREA))
        self._level = (footprint_px >= 1.5).int() + (footprint_px >= 3.0).int()

    def sample(
        self, pixels_uv: Float[Tensor, "rows 2"], rows: Int[Tensor, " rows"] | None = None
    ) -> UInt8[Tensor, "rows 3"]:
        """Colours at positions; `rows` says which points they belong to if not all."""
        level = self._level if rows is None else self._level[rows]
        return torch.from_numpy(
            sample_levels(pixels_uv.contiguous().numpy(), level.numpy(), *self._images)
        )


def rim_samples(
    levels: ImageLevels,
    points: PointsInView,
    visibility: Visibility,
    grid: CellGrid,
) -> tuple[UInt8[Tensor, "points 3"], Float[Tensor, " points"]]:
    """Colours of visible points, and how far the place of each is to be trusted.

    On the rim of a surface a small error of pose takes the colour of what is beside it. Where the
    colour there is more like that beyond the rim than like that of the nearest inner cell, the
    inner one is taken. `points` are those that nothing hides; `grid` is that of the visibility.
    """
    rgb = levels.sample(points.pixels_uv)
    trust = torch.ones_like(points.depth_m)
    cells_uv = grid.cells_of(points.pixels_uv)
    column, row = cells_uv.unbind(-1)
    nearest_m, furthest_m = visibility.nearest_m[row, column], visibility.furthest_m[row, column]
    is_behind = nearest_m < points.depth_m * (1 - EDGE_TOLERANCE)
    is_before = furthest_m > points.depth_m * (1 + EDGE_TOLERANCE)
    trust[is_behind] = BEHIND_EDGE_WEIGHT
    on_rim = is_before.nonzero()[:, 0]
    trust[on_rim] *= RIM_WEIGHT
    steps, has_inner = map(
        torch.from_numpy,
        steps_inside(
            cells_uv[on_rim].numpy(),
            points.depth_m[on_rim].numpy(),
            visibility.inner_m.numpy(),
            INNER_REACH,
            EDGE_TOLERANCE,
        ),
    )
    moved, steps_px = on_rim[has_inner], steps[has_inner] / grid.cells_per_pixel
    own = rgb[moved].float()
    inner = levels.sample(points.pixels_uv[moved] + steps_px, moved)
    beyond = levels.sample(points.pixels_uv[moved] - steps_px, moved)
    to_inner, to_beyond = (own - inner.float()).norm(dim=-1), (own - beyond.float()).norm(dim=-1)
    is_foreign = (to_beyond < FOREIGN_LIKENESS) & (to_inner > FOREIGN_CONTRAST)
    rgb[moved[is_foreign]] = inner[is_foreign]
    return rgb, trust
