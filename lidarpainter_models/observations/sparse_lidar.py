"""Points from images where a LiDAR has too few to tell the street that the images show.

How much of the street a LiDAR tells is measured and not read off its beams: a car that drives on
sweeps with few of them what a standing one sweeps with many. Where it tells too little, points from
images join its own, but for those beside a measured one. World: z up; metres.
"""

import math
from collections.abc import Mapping, Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.spatial import cKDTree
from torch import Tensor

from lidarpainter_models.lidar.lidar_map import LidarMap, MapPoints
from lidarpainter_models.observations.own_body import on_grid
from lidarpainter_models.scenes.records import RecordedView
from lidarpainter_models.scenes.splits import sampled_views

LEAST_TOLD = 0.5
"""Below it images complete the LiDAR.

The front camera of a street has 0.90 with 16 beams, 0.73 with 8 and 0.42 with 4. It cannot be
higher: beside and behind the car, where a LiDAR on the roof never looks, PandaSet 002 has 0.63
(left) and 0.51 (back, the car's own body among it) with 64.
"""
CELL_RAD = math.radians(1.0)
"""Angle of a cell of an image, and around a measured point in which it stands for the surface."""
LEAST_ON_ACTOR = 20
"""Fewer points do not tell an actor's shape; its box does."""
_MOST_VIEWS, _MOST_POINTS = 24, 200_000


def share_told(
    street: MapPoints,
    views: Sequence[RecordedView],
    own_bodies: Mapping[str, Bool[np.ndarray, "rows columns"]],
) -> float:
    """Of the cells of the images below the horizon, the part that holds a point of the street.

    Cells of the recording car itself are left out; 1 where no image looks below the horizon. Of
    many points an even part is looked at, of many views, each camera's in order of time, some.
    """
    step = max(1, -(-len(street) // _MOST_POINTS))
    points_world = street.xyz_m[::step]
    told = of_all = 0
    for view in sampled_views(views, _MOST_VIEWS):
        asked, hit = _cells(view, points_world, own_bodies.get(view.camera_name))
        told += int((asked & hit).sum())
        of_all += int(asked.sum())
    return told / of_all if of_all else 1.0


def _cells(
    view: RecordedView,
    points_world: Float[Tensor, "points 3"],
    own_body: Bool[np.ndarray, "rows columns"] | None,
) -> tuple[Bool[Tensor, "height width"], Bool[Tensor, "height width"]]:
    """Cells that look below the horizon, and those that hold a point."""
    full = view.camera
    camera = full.resized(
        width_px=max(1, round(full.width_px / (full.fx_px * CELL_RAD))),
        height_px=max(1, round(full.height_px / (full.fy_px * CELL_RAD))),
    )
    down = camera.pixel_directions() @ camera.world_from_camera[2, :3].float()
    asked = down < -CELL_RAD
    if own_body is not None:
        asked &= ~on_grid(own_body, width_px=camera.width_px, height_px=camera.height_px)
    pixels_uv, depth_m = camera.project(points_world)
    column, row = pixels_uv[camera.contains(pixels_uv, depth_m)].long().unbind(-1)
    hit = torch.zeros_like(asked)
    hit[row, column] = True
    return asked, hit


def completed(measured: LidarMap, estimated: LidarMap) -> LidarMap:
    """What was measured, and of what was estimated from images that which lies not beside it.

    Beside means within `CELL_RAD` of a measured point, at the range of the estimate. An actor has
    its returns alone from `LEAST_ON_ACTOR` of them on, else its estimated points alone. The street
    that was estimated must not be empty.
    """
    street = estimated.street
    nearest_m, _ = cKDTree(measured.street.xyz_m.numpy()).query(
        street.xyz_m.numpy(), distance_upper_bound=float(street.range_m.max()) * CELL_RAD
    )
    is_new = torch.from_numpy(nearest_m) > CELL_RAD * street.range_m
    told = {name: own for name, own in measured.actors.items() if len(own) >= LEAST_ON_ACTOR}
    return LidarMap(
        street=MapPoints.concatenate([measured.street, street.keep(is_new)]),
        actors=estimated.actors | told,
    )
