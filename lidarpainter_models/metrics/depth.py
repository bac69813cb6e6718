"""How well rendered depth agrees with LiDAR that the fit never saw.

Depth is camera z in metres. A LiDAR point counts only where the camera can see it: the z-buffer of
the points themselves (grown by a few pixels, since points are sparse) hides what lies behind.
"""

from dataclasses import dataclass
from functools import partial

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.kernels.point_splat import splat_points

INLIER_TOLERANCE = 0.05
"""A rendered depth is an inlier within 5 % of the measured one."""
OCCLUDER_RADIUS_PX = 2
"""Points hide others in the pixels around them: a sweep does not cover every pixel."""
OCCLUDER_TOLERANCE = 0.03
"""A point is hidden when it lies more than this part of its depth behind the z-buffer."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DepthScores:
    """Agreement of one rendered depth map with one sweep."""

    inliers: int
    points: int


def visible_points(
    camera: Camera, points_world: Float[Tensor, "points 3"]
) -> tuple[Int[Tensor, "visible 2"], Float[Tensor, " visible"]]:
    """Pixels (column, row) and depths of the points that no other point hides, one per pixel."""
    pixels_uv, depth_m = camera.project(points_world.to(torch.float32))
    inside = camera.contains(pixels_uv, depth_m)
    pixels, depth_m = pixels_uv[inside].floor().to(torch.int32), depth_m[inside].contiguous()
    splat = partial(
        splat_points, pixels, depth_m, height_px=camera.height_px, width_px=camera.width_px
    )
    nearest = splat(radius_px=0).reshape(-1)
    front = splat(radius_px=OCCLUDER_RADIUS_PX).reshape(-1)
    hit = nearest >= 0
    own_m = depth_m[nearest[hit].long()]
    front_m = depth_m[front[hit].long()]
    is_visible = own_m <= front_m * (1 + OCCLUDER_TOLERANCE)
    flat = torch.nonzero(hit)[:, 0][is_visible]
    pixels_seen = torch.stack([flat % camera.width_px, flat // camera.width_px], dim=-1)
    return pixels_seen.to(torch.int32), own_m[is_visible]


def score_depth(
    rendered_depth_m: Float[Tensor, "height width"],
    camera: Camera,
    points_world: Float[Tensor, "points 3"],
) -> DepthScores:
    """Compare a depth map with the visible points of a sweep; a hole (0) is never an inlier."""
    pixels, depth_m = visible_points(camera, points_world)
    rendered = rendered_depth_m[pixels[:, 1].long(), pixels[:, 0].long()]
    is_inlier: Bool[Tensor, " visible"] = (rendered - depth_m).abs() <= INLIER_TOLERANCE * depth_m
    return DepthScores(inliers=int(is_inlier.sum()), points=depth_m.numel())


def pooled_inlier_fraction(scores: list[DepthScores]) -> float | None:
    """Inliers over points of all views together; None where nothing was visible."""
    points = sum(score.points for score in scores)
    return sum(score.inliers for score in scores) / points if points else None
