"""Which pixels of a camera boxes cover; boxes as in `boxes`, depth is camera z in metres."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from lidarpainter_models.geometry.boxes import BOX_EDGES, box_corners
from lidarpainter_models.geometry.cameras import Camera

NEAR_M = 0.5
"""What of a box is nearer to the image plane than this, or behind it, is cut off."""
FARTHEST_PX = 1e4
"""Outlines are clamped so far out, where they fit into OpenCV's integers."""

_CORNERS = box_corners(torch.ones(3, dtype=torch.float64)).numpy()
_EDGES = np.array(BOX_EDGES).T


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BoxOutline:
    """A box as a camera sees it."""

    box: int
    """Position among the boxes."""
    pixels_uv: Float[np.ndarray, "corners 2"]
    """Their convex hull is the box; clamped to `FARTHEST_PX`."""
    far_m: float
    """Depth of the furthest corner."""

    @property
    def hull(self) -> Int[np.ndarray, "hull 1 2"]:
        """The outline in whole pixels, whose centres lie half a pixel in, as OpenCV fills it."""
        return cv2.convexHull(np.round(self.pixels_uv - 0.5).astype(np.int32))


def box_outlines(
    camera: Camera, world_from_boxes: Float[Tensor, "boxes 4 4"], sizes_m: Float[Tensor, "boxes 3"]
) -> list[BoxOutline]:
    """Outlines of the boxes that reach into the image, in their order."""
    camera_from_box = (camera.camera_from_world.double() @ world_from_boxes.double()).numpy()
    corners = _CORNERS * sizes_m.double().numpy()[:, None]
    corners = corners @ camera_from_box[:, :3, :3].swapaxes(1, 2) + camera_from_box[:, None, :3, 3]
    is_front = corners[..., 2] >= NEAR_M
    outlines = []
    for box in np.flatnonzero(is_front.any(axis=1)):
        seen = corners[box]
        if not is_front[box].all():
            seen = np.concatenate([seen[is_front[box]], _on_near_plane(seen, is_front[box])])
        u = seen[:, 0] / seen[:, 2] * camera.fx_px + camera.cx_px
        v = seen[:, 1] / seen[:, 2] * camera.fy_px + camera.cy_px
        # outlines are rounded to whole pixels: one beside the image may still touch it
        is_beside = u.max() < -1 or u.min() > camera.width_px + 1
        if is_beside or v.max() < -1 or v.min() > camera.height_px + 1:
            continue
        pixels_uv = np.stack([u, v], axis=1).clip(-FARTHEST_PX, FARTHEST_PX)
        far_m = float(corners[box, :, 2].max())
        outlines.append(BoxOutline(box=int(box), pixels_uv=pixels_uv, far_m=far_m))
    return outlines


def project_boxes(
    camera: Camera,
    world_from_boxes: Float[Tensor, "actors 4 4"],
    sizes_m: Sequence[Float[Tensor, "3"]] | Float[Tensor, "actors 3"],
    present: Bool[Tensor, " actors"],
    *,
    margin: float = 1.1,
) -> Bool[Tensor, "height width"]:
    """Pixels covered by any of the boxes, slightly grown."""
    mask = np.zeros((camera.height_px, camera.width_px), np.uint8)
    if bool(present.any()):
        sizes = torch.stack(list(sizes_m))[present].double() * margin
        for outline in box_outlines(camera, world_from_boxes[present], sizes):
            cv2.fillConvexPoly(mask, outline.hull, 1)
    return torch.from_numpy(mask.astype(bool))


def _on_near_plane(
    corners: Float[np.ndarray, "8 3"], is_front: Bool[np.ndarray, "8"]
) -> Float[np.ndarray, "cut 3"]:
    """Where the edges of a box in the camera frame meet the near plane."""
    first, second = _EDGES[:, is_front[_EDGES[0]] != is_front[_EDGES[1]]]
    depth_m = corners[:, 2]
    share = (NEAR_M - depth_m[first]) / (depth_m[second] - depth_m[first])
    on_plane = corners[first] + share[:, None] * (corners[second] - corners[first])
    on_plane[:, 2] = NEAR_M
    return on_plane
