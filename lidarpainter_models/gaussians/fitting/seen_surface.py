"""How much surface the training views show, and which of them show something new.

A surface counts at the finest it was seen: A square metres at a pixel's footprint of f metres are
A / f^2 pixels. A view that sees it after others at footprint g adds (1 - (f / g)^2) of its own
pixels, or none where g <= f. Depth is the LiDAR's, that of all points of the street where it tells
too little. So views from one place count once, views of a moving car add up to
the finest of them, and cameras that overlap share. Occlusion is not looked at: what traffic
uncovers before a standing car counts as seen. Painted views add what lies in no recorded image.
Metres; the world frame.

Gaussians are planned by detail. Where n of them leave s^2 / n of an image's variance s^2 in a cell,
one more is worth the same everywhere if n follows s: the contrast of cells of a few pixels, summed
over the surface.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import adaptive_avg_pool2d, avg_pool2d

from lidarpainter_models.gaussians.fitting.images import shrink_depth
from lidarpainter_models.gaussians.initialisation.unreached import depth_from_below
from lidarpainter_models.geometry.cameras import Camera, outside_all
from lidarpainter_models.lidar.sparse_depth import sparse_lidar_depth
from lidarpainter_models.observations.views import GuidanceView, TrainingView

CELL_PX = 12
"""A cell of pixels is judged by one point: LiDAR leaves few of them empty."""
LEAST_NEW = 0.02
"""A view that adds less of itself shows nothing new: depths are noisy, engines shake."""
COMPARED_VIEWS = 32
"""Earlier views that showed something new, the nearest ones, with which a view is compared."""
CONTRAST_CELL_PX = 4
"""Pixels along a cell whose contrast counts: what few Gaussians could show is finer."""
TYPICAL_CONTRAST = 0.04
"""Standard deviation of grey in such cells ahead of a car in a street, in parts of white: 0.03 to
0.055 in images 96 to 960 pixels wide of PandaSet 002 and two synthetic streets."""
LEAST_DETAIL = 0.25
"""Detail of a pixel of surface at the least: by night LiDAR still sees it."""


@dataclass(frozen=True, kw_only=True, eq=False)
class SeenSurface:
    """What a set of training views shows."""

    num_pixels: float
    """Pixels of surface, each at the finest it was seen."""
    num_detailed: float
    """Pixels by their contrast: as many of a typical street hold this detail."""
    whole_views: float
    """Surface in views: the first one counts 1, each other by what is new in it."""
    groups: tuple[tuple[int, ...], ...]
    """Positions of the views: one that shows something new, and those after it of its camera that
    add nothing to it."""


def seen_surface(
    views: Sequence[TrainingView], street: Float[Tensor, "points 3"] | None = None
) -> SeenSurface:
    """Measure what the views show, in the order in which they were taken.

    Args:
        views: with LiDAR depth.
        street: points that tell more of the street than that, in the world.
    """
    order = sorted(range(len(views)), key=lambda index: views[index].timestamp_ns)
    num_pixels = num_detailed = whole_views = 0.0
    groups: dict[str, list[list[int]]] = {}
    kept: list[Camera] = []
    for index in order:
        view = views[index]
        new = _new_shares(*_cells(view, street)[1:], _nearest(kept, view.camera))
        share = float(new.mean()) if len(new) else 0.0
        of_camera = groups.setdefault(view.key[1], [])
        if of_camera and share < LEAST_NEW:
            of_camera[-1].append(index)
            continue
        of_camera.append([index])
        kept.append(view.camera)
        whole_views += share
        num_pixels += share * int(view.shows_surface.sum())
        num_detailed += share * _detail(view)
    return SeenSurface(
        num_pixels=num_pixels,
        num_detailed=max(num_detailed, LEAST_DETAIL * num_pixels),
        whole_views=whole_views,
        groups=tuple(tuple(group) for of_camera in groups.values() for group in of_camera),
    )


def with_shown_beside(
    surface: SeenSurface, views: Sequence[TrainingView], guidance: Sequence[GuidanceView]
) -> SeenSurface:
    """Return the surface with what painted views show and no recorded one does, by its contrast.

    There a cell with any return of LiDAR shows surface. It takes Gaussians; looks are at recorded
    views, as without it.
    """
    painted = sorted(guidance, key=lambda view: view.timestamp_ns)
    cells = [_cells(view, None, least_shown=0.0) for view in painted]
    if not cells:
        return surface
    points_world = torch.cat([points for _, points, _ in cells])
    is_unseen = torch.zeros_like(points_world[:, 0], dtype=torch.bool)
    is_unseen[outside_all(points_world, [view.camera for view in views])] = True
    unseen_cells = is_unseen.split([len(points) for _, points, _ in cells])
    num_pixels = num_detailed = 0.0
    earlier: list[Camera] = []
    for view, (is_solid, points, footprint_m), unseen in zip(
        painted, cells, unseen_cells, strict=True
    ):
        if unseen.any():
            new = _new_shares(points, footprint_m, _nearest(earlier, view.camera)) * unseen
            rows, columns = is_solid.shape
            contrast = adaptive_avg_pool2d(_contrast(view)[None], (rows, columns))[0][is_solid]
            num_pixels += float(new.sum()) * CELL_PX**2
            num_detailed += float((new * contrast).sum()) * CELL_PX**2 / TYPICAL_CONTRAST
        earlier.append(view.camera)
    return replace(
        surface,
        num_pixels=surface.num_pixels + num_pixels,
        num_detailed=surface.num_detailed + max(num_detailed, LEAST_DETAIL * num_pixels),
    )


def _detail(view: TrainingView) -> float:
    """Pixels of a typical street with the detail that a view shows of surface."""
    shown = avg_pool2d(view.shows_surface.float()[None], CONTRAST_CELL_PX)[0]
    return float((_contrast(view) * shown).sum()) * CONTRAST_CELL_PX**2 / TYPICAL_CONTRAST


def _contrast(view: TrainingView | GuidanceView) -> Float[Tensor, "rows columns"]:
    """Standard deviation of grey in each cell of a few pixels."""
    cells = partial(avg_pool2d, kernel_size=CONTRAST_CELL_PX)
    grey = view.rgb.mean(dim=-1)[None]
    return (cells(grey.square()) - cells(grey).square()).clamp(min=0).sqrt()[0]


def _new_shares(
    points_world: Float[Tensor, "cells 3"],
    footprint_m: Float[Tensor, " cells"],
    earlier: Sequence[Camera],
) -> Float[Tensor, " cells"]:
    """Return which part of each cell that is not sky no earlier camera saw as finely."""
    known = torch.zeros_like(footprint_m)
    for camera in earlier:
        pixels_uv, depth_m = camera.project(points_world)
        as_fine = (footprint_m * camera.fx_px / depth_m.clamp(min=1e-3)).square()
        known = torch.maximum(known, as_fine * camera.contains(pixels_uv, depth_m))
    return (1 - known).clamp(min=0)


def _cells(
    view: TrainingView | GuidanceView,
    street: Float[Tensor, "points 3"] | None,
    *,
    least_shown: float = 0.5,
) -> tuple[Bool[Tensor, "rows columns"], Float[Tensor, "cells 3"], Float[Tensor, " cells"]]:
    """Which cells of pixels show surface, a point for each such, and a pixel's footprint there.

    Of such a cell more than `least_shown` shows surface, as a share.
    """
    grid = {
        "width_px": max(view.camera.width_px // CELL_PX, 1),
        "height_px": max(view.camera.height_px // CELL_PX, 1),
    }
    small = view.camera.resized(**grid)
    depth_m = shrink_depth(view.lidar_depth_m, **grid)
    if street is not None:
        depth_m = sparse_lidar_depth(street, small)
    depth_m = depth_from_below(depth_m)
    size = (grid["height_px"], grid["width_px"])
    shown = adaptive_avg_pool2d(view.shows_surface.float()[None], size)[0]
    is_solid = shown > least_shown
    points_world = small.unproject(depth_m)[is_solid]
    return is_solid, points_world, depth_m[is_solid] / view.camera.fx_px


def _nearest(cameras: Sequence[Camera], to: Camera) -> list[Camera]:
    """The cameras that stand nearest, in their order."""
    if len(cameras) <= COMPARED_VIEWS:
        return list(cameras)
    centres = torch.stack([camera.centre_world for camera in cameras])
    distance_m = (centres - to.centre_world).norm(dim=1)
    nearest = distance_m.argsort(stable=True)[:COMPARED_VIEWS]
    return [cameras[int(row)] for row in nearest.sort().values]
