"""Images of a rig's cameras as one: who looks ahead above, who looks back below, left to right."""

import math
from collections.abc import Sequence

import cv2
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import pad

MOST_AHEAD_DEG = 80.0
"""Cameras that look farther aside stand in the lower row: of the rigs that readers know, the front
ring of three stands above."""


def rig_rows(ego_from_camera: Float[Tensor, "cameras 4 4"]) -> tuple[tuple[int, ...], ...]:
    """Positions of the cameras, row by row, so that what is on the left in the car is on the left.

    Cameras that look the same way stand in the order of their lenses.
    """
    upper: list[tuple[int, float, int]] = []
    lower: list[tuple[int, float, int]] = []
    for camera, pose in enumerate(ego_from_camera.tolist()):
        azimuth_deg = math.degrees(math.atan2(pose[1][2], pose[0][2]))  # of z, which looks ahead
        from_behind_deg = math.copysign(180 - abs(azimuth_deg), azimuth_deg)
        is_ahead = abs(azimuth_deg) <= MOST_AHEAD_DEG
        left_deg = azimuth_deg if is_ahead else from_behind_deg
        (upper if is_ahead else lower).append((-round(left_deg), -pose[1][3], camera))
    return tuple(tuple(camera for *_, camera in sorted(row)) for row in (upper, lower) if row)


def tiled(
    images: Sequence[Float[Tensor, "_ _ 3"]], rows: Sequence[Sequence[int]]
) -> Float[Tensor, "height width 3"]:
    """One image of several: all as high as the least high, the narrower row in the middle."""
    height_px = min(image.shape[0] for image in images)
    strips = [torch.cat([_as_high(images[one], height_px) for one in row], dim=1) for row in rows]
    width_px = max(strip.shape[1] for strip in strips)
    return torch.cat([_centred(strip, width_px) for strip in strips])


def _as_high(image: Float[Tensor, "_ _ 3"], height_px: int) -> Float[Tensor, "{height_px} _ 3"]:
    image = image.detach().cpu()
    height, width, _ = image.shape
    if height == height_px:
        return image
    size = (max(round(width * height_px / height), 1), height_px)
    return torch.from_numpy(cv2.resize(image.numpy(), size, interpolation=cv2.INTER_AREA))


def _centred(
    strip: Float[Tensor, "height _ 3"], width_px: int
) -> Float[Tensor, "height {width_px} 3"]:
    lacking = width_px - strip.shape[1]
    return pad(strip, (0, 0, lacking // 2, lacking - lacking // 2))
