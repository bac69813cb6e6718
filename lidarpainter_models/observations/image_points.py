"""Points from training images alone, for a log without LiDAR or with few beams.

Each image is compared with neighbours of the same camera over a sweep of depths (`plane_sweep`);
of all pixels those are kept whose depth is clearly better than any other and which a neighbour
finds at the same place. What moves is left out: its pixels contradict the parallax of the street.
Moving actors get points on their boxes, all that is known of their shape.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.lidar.colouring import BEAM_SPACING_RAD
from lidarpainter_models.lidar.lidar_map import LidarMap, MapPoints
from lidarpainter_models.lidar.points_on_actors import MovingBoxes
from lidarpainter_models.observations.image_shrinking import fit_camera, shrink_image
from lidarpainter_models.observations.own_body import baseline_m, on_grid
from lidarpainter_models.observations.plane_sweep import depth_between, sweep_cost, sweep_depths
from lidarpainter_models.observations.settings import ObservationConfig
from lidarpainter_models.scenes.driving_scene import DrivingScene
from lidarpainter_models.scenes.records import RecordedView
from lidarpainter_models.scenes.tracks import ActorTrack

WIDTH = ObservationConfig(width_px=320)
"""Size at which images are compared: finer ones cost more than they tell."""
MOST_VIEWS_PER_CAMERA = 24
"""Images that get a depth, evenly over the log: 1.5 s of CPU each."""
NEIGHBOURS = 2
"""Images before and after that each is compared with."""
LEAST_BASELINE_M = 0.2
"""Images taken nearer to each other than this show no parallax."""
DEPTHS_M = sweep_depths(2.5, 200.0, 64)
"""Depths that are tried."""
FARTHEST_M = 120.0
"""Further points have no depth to speak of: they are left to what lies behind everything."""
MOST_COST_RATIO = 0.8
"""Cost of the best depth over that of the best one elsewhere: more tells nothing."""
LEAST_COST = 0.01
"""Standard deviations of contrast: what costs less everywhere, as a blown sky, tells nothing."""
SAME_DEPTH = 0.06
"""Two images find the same place if they differ by at most this part of its depth."""
BOX_SPACING_M = 0.1
"""Between points on the box of an actor."""
BOX_SHARE = 0.95
"""Boxes are labelled around an actor; its surface lies this far out."""
_CONTRAST_SIGMA_PX = 6.0
_MOST_CONTRAST = 2.0  # standard deviations


@dataclass(frozen=True, kw_only=True, eq=False)
class _Image:
    """A training image made ready for the comparison."""

    view: RecordedView
    camera: Camera
    contrast: Float[Tensor, "height width 1"]
    """Brightness, its local mean and contrast taken out: exposures differ."""
    moves: Bool[Tensor, "height width"]
    """Pixels of moving actors and of the recording car."""


def points_from_images(
    scene: DrivingScene,
    views: Sequence[RecordedView],
    own_bodies: Mapping[str, Bool[np.ndarray, "rows columns"]],
) -> LidarMap:
    """Points of the street where images show it, and of moving actors on their boxes.

    None of the street where the images show no parallax that could be measured. Only images of
    these views are used; `own_bodies` are what of a camera's is the recording car, on any grid.
    """
    tracks = [track for track in scene.tracks if track.is_moving]
    boxes = MovingBoxes(tracks)
    parts = [
        part
        for name in scene.camera_names
        for part in _of_camera(
            scene, boxes, [view for view in views if view.camera_name == name], own_bodies.get(name)
        )
    ]
    street = MapPoints.concatenate(parts)
    return LidarMap(street=street, actors={track.actor_id: _on_box(track) for track in tracks})


def _of_camera(
    scene: DrivingScene,
    boxes: MovingBoxes,
    views: Sequence[RecordedView],
    own_body: Bool[np.ndarray, "rows columns"] | None,
) -> list[MapPoints]:
    """The points that each image of a camera gives."""
    apart: list[RecordedView] = []
    for view in views[:: max(1, -(-len(views) // MOST_VIEWS_PER_CAMERA))]:
        if not apart or baseline_m(apart[-1], view) >= LEAST_BASELINE_M:
            apart.append(view)
    if len(apart) < 2:
        return []
    images = [_made_ready(view, scene.read_image(view), boxes, own_body) for view in apart]
    depths = [_swept_depth(images, place) for place in range(len(images))]
    confirmed = [torch.zeros_like(depth_m, dtype=torch.bool) for depth_m in depths]
    for first, second in pairwise(range(len(images))):
        for one, other in ((first, second), (second, first)):
            confirmed[one] |= _agrees(images[one], depths[one], images[other], depths[other])
    return [
        _points(image, torch.where(is_sure, depth_m, 0.0))
        for image, depth_m, is_sure in zip(images, depths, confirmed, strict=True)
    ]


def _made_ready(
    view: RecordedView,
    rgb_u8: UInt8[Tensor, "rows columns 3"],
    boxes: MovingBoxes,
    own_body: Bool[np.ndarray, "rows columns"] | None,
) -> _Image:
    camera = fit_camera(view, WIDTH)
    small = shrink_image(rgb_u8, width_px=camera.width_px, height_px=camera.height_px)
    grey = cv2.cvtColor(small.numpy(), cv2.COLOR_RGB2GRAY).astype(np.float32)
    away = grey - cv2.GaussianBlur(grey, (0, 0), _CONTRAST_SIGMA_PX)
    spread = np.sqrt(cv2.GaussianBlur(away**2, (0, 0), _CONTRAST_SIGMA_PX))
    contrast = np.clip(away / (spread + 4), -_MOST_CONTRAST, _MOST_CONTRAST) / (2 * _MOST_CONTRAST)
    moves = boxes.pixels(camera, view.timestamp_ns)
    if own_body is not None:
        moves |= on_grid(own_body, width_px=camera.width_px, height_px=camera.height_px)
    return _Image(
        view=view, camera=camera, contrast=torch.from_numpy(contrast)[..., None], moves=moves
    )


def _swept_depth(images: list[_Image], place: int) -> Float[Tensor, "height width"]:
    """Depth of one of a camera's images, 0 where nothing tells."""
    image = images[place]
    around = images[max(0, place - NEIGHBOURS) : place] + images[place + 1 : place + 1 + NEIGHBOURS]
    if not around:
        return torch.zeros(image.moves.shape)
    others = [(other.camera, other.contrast) for other in around]
    cost = sweep_cost(image.camera, image.contrast, others, DEPTHS_M)
    best, index = cost.min(dim=0)
    is_near = (torch.arange(len(DEPTHS_M))[:, None, None] - index).abs() <= NEIGHBOURS + 1
    elsewhere = torch.where(is_near, torch.inf, cost).amin(dim=0)
    depth_m = depth_between(cost, index, DEPTHS_M)
    is_clear = best.clamp(min=LEAST_COST) < MOST_COST_RATIO * elsewhere
    is_clear &= (depth_m < FARTHEST_M) & ~image.moves
    return torch.where(is_clear, depth_m, 0.0)


def _agrees(
    image: _Image,
    depth_m: Float[Tensor, "height width"],
    other: _Image,
    other_depth_m: Float[Tensor, "height width"],
) -> Bool[Tensor, "height width"]:
    """Where another image has a depth for the same place."""
    pixels_uv, expected_m = other.camera.project(image.camera.unproject(depth_m).reshape(-1, 3))
    is_inside = other.camera.contains(pixels_uv, expected_m, near_m=float(DEPTHS_M[0]))
    is_inside &= (depth_m > 0).reshape(-1)
    column, row = pixels_uv[is_inside].long().unbind(-1)
    off = (other_depth_m[row, column] - expected_m[is_inside]).abs()
    agrees = torch.zeros(depth_m.numel(), dtype=torch.bool)
    agrees[is_inside] = off < SAME_DEPTH * expected_m[is_inside]
    return agrees.reshape(depth_m.shape)


def _points(image: _Image, depth_m: Float[Tensor, "height width"]) -> MapPoints:
    """The pixels that have a depth, in the world."""
    is_known = depth_m > 0
    xyz_m = image.camera.unproject(depth_m)[is_known].float()
    count = xyz_m.shape[0]
    return MapPoints.uncoloured(
        xyz_m=xyz_m,
        frame_index=torch.full((count,), image.view.frame_index),
        timestamp_ns=torch.full((count,), image.view.timestamp_ns),
        range_m=(xyz_m - image.camera.centre_world.float()).norm(dim=-1),
    )


def _on_box(track: ActorTrack) -> MapPoints:
    """A grid of points on the sides and the top of an actor's box, in its frame."""
    half_m = track.size_m.float() * BOX_SHARE / 2
    ticks = [
        torch.linspace(-1, 1, max(2, round(2 * float(side) / BOX_SPACING_M) + 1)) for side in half_m
    ]
    grid = torch.cartesian_prod(*ticks)
    on_surface = (grid[:, :2].abs() == 1).any(dim=1) | (grid[:, 2] == 1)
    xyz_m = grid[on_surface] * half_m
    middle, count = len(track.timestamps_ns) // 2, xyz_m.shape[0]
    return MapPoints.uncoloured(
        xyz_m=xyz_m,
        frame_index=track.frame_indices[middle].expand(count).clone(),
        timestamp_ns=track.timestamps_ns[middle].expand(count).clone(),
        range_m=torch.full((count,), BOX_SPACING_M / BEAM_SPACING_RAD),
    )
