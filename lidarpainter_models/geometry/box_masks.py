"""Which pixels of a camera boxes cover; boxes as in `boxes`, depth is camera z in metres."""

from collections.abc import Sequence

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from lidarpainter_models.geometry.boxes import BOX_EDGES, box_corners
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.geometry.transforms import transform_points

NEAR_M = 0.5
"""What of a box is nearer to the image plane than this, or behind it, is cut off."""
FARTHEST_PX = 1e4
"""Outlines are clamped so far out, where they fit into OpenCV's integers."""


def project_box(
    camera: Camera, world_from_box: Float[Tensor, "4 4"], size_m: Float[Tensor, "3"]
) -> Float[Tensor, "corners 2"]:
    """Pixels whose convex hull is a box seen by a camera; none of a box behind the near plane."""
    corners = transform_points(world_from_box.double(), box_corners(size_m.double()))
    pixels_uv, depth_m = camera.project(corners)
    is_front = depth_m >= NEAR_M
    if bool(is_front.all()):
        return pixels_uv
    first, second = torch.tensor(BOX_EDGES).unbind(1)
    cut = is_front[first] != is_front[second]
    first, second = first[cut], second[cut]
    share = (NEAR_M - depth_m[first]) / (depth_m[second] - depth_m[first])
    on_plane = torch.lerp(corners[first], corners[second], share[:, None])
    return torch.cat([pixels_uv[is_front], camera.project(on_plane)[0]])


def project_boxes(
    camera: Camera,
    world_from_boxes: Float[Tensor, "actors 4 4"],
    sizes_m: Sequence[Float[Tensor, "3"]],
    present: Bool[Tensor, " actors"],
    *,
    margin: float = 1.1,
) -> Bool[Tensor, "height width"]:
    """Pixels covered by any of the boxes, slightly grown."""
    mask = np.zeros((camera.height_px, camera.width_px), np.uint8)
    for pose, size_m, is_present in zip(world_from_boxes, sizes_m, present.tolist(), strict=True):
        if not is_present:
            continue
        pixels_uv = project_box(camera, pose, size_m.double() * margin)
        if len(pixels_uv):
            clamped = pixels_uv.numpy().clip(-FARTHEST_PX, FARTHEST_PX)
            cv2.fillConvexPoly(mask, cv2.convexHull(clamped.round().astype(np.int32)), 1)
    return torch.from_numpy(mask.astype(bool))
