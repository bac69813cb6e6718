"""Which pixels of a camera boxes cover; boxes as in `boxes`, depth is camera z in metres."""

from collections.abc import Sequence

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from lidarpainter_models.geometry.boxes import box_corners
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.geometry.transforms import transform_points


def project_boxes(
    camera: Camera,
    world_from_boxes: Float[Tensor, "actors 4 4"],
    sizes_m: Sequence[Float[Tensor, "3"]],
    present: Bool[Tensor, " actors"],
    *,
    margin: float = 1.1,
) -> Bool[Tensor, "height width"]:
    """Pixels covered by any of the boxes, slightly grown; a box across the camera covers all."""
    mask = np.zeros((camera.height_px, camera.width_px), np.uint8)
    for pose, size_m, is_present in zip(world_from_boxes, sizes_m, present.tolist(), strict=True):
        if not is_present:
            continue
        corners = transform_points(pose.double(), box_corners(size_m.double() * margin))
        pixels_uv, depth_m = camera.project(corners)
        if bool((depth_m < 0.5).all()):
            continue
        if bool((depth_m < 0.5).any()):
            mask[:] = 1
            break
        hull = cv2.convexHull(pixels_uv.numpy().clip(-1e4, 1e4).round().astype(np.int32))
        cv2.fillConvexPoly(mask, hull, 1)
    return torch.from_numpy(mask.astype(bool))
