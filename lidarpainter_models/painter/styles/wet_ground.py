"""A wet road is a mirror for what stands on it.

What it mirrors is found by following the mirrored ray through the image's own depth (screen-space
reflection), and where it leaves the image or hits nothing, the overcast sky stands in.
"""

import math

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.painter.styles.view import SKY_M, Ground

GROUND_HEIGHT_M = 0.2
"""Surfaces up to this height are ground."""
FARTHEST_STEP_M = 200.0
NUM_STEPS = 80
FILM_ROUGHNESS_RAD = 0.012
"""Blur of a reflection along the column: waves smear it towards the viewer."""


def ground_pixels(
    points_m: Float[Tensor, "height width 3"],
    ground: Ground,
    surface: Bool[Tensor, "height width"],
) -> Float[Tensor, "height width"]:
    """Share of every pixel that is ground, soft along its rim."""
    low = surface & (ground.heights(points_m).abs() < GROUND_HEIGHT_M)
    opened = cv2.morphologyEx(low.numpy().astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3)))
    closed = cv2.morphologyEx(opened, cv2.MORPH_CLOSE, np.ones((5, 5)))
    return torch.from_numpy(cv2.GaussianBlur(closed.astype(np.float32), (0, 0), 1.0))


def mirrored(
    light: Float[Tensor, "height width 3"],
    sky_light: Float[Tensor, "3"],
    camera: Camera,
    points_m: Float[Tensor, "height width 3"],
    on_ground: Bool[Tensor, "height width"],
) -> Float[Tensor, "height width 3"]:
    """What each ground pixel mirrors, blurred along the column as by a rough film.

    `light` is linear, world z up; points are metres from the camera's centre, sky at infinity.
    `sky_light` stands in where the image does not show what is mirrored.
    """
    starts = points_m[on_ground]
    directions = torch.nn.functional.normalize(starts, dim=-1) * torch.tensor([1.0, 1.0, -1.0])
    camera_from_world = camera.world_from_camera[:3, :3].T.float()
    depth_m = (points_m @ camera_from_world.T)[..., 2]
    found = sky_light.expand(len(starts), 3).clone()
    waiting = torch.ones(len(starts), dtype=torch.bool)
    reaches = torch.logspace(-0.5, math.log10(FARTHEST_STEP_M), NUM_STEPS)
    for reach_m in (*reaches.tolist(), SKY_M):
        ray = (starts + reach_m * directions) @ camera_from_world.T
        row, column, inside = _pixel(camera, ray)
        behind_m = ray[:, 2] - depth_m[row, column]
        # steps grow with reach, and surfaces are taken to be as thick as a step is long
        hit = (behind_m > 0) & (behind_m < 0.5 + 0.35 * reach_m)
        hit &= ~on_ground[row, column]  # a plane does not mirror itself; its rows are far apart
        if reach_m == SKY_M:
            hit |= True  # nothing was met: what stands there is the horizon
        hit &= inside & waiting
        found[hit] = light[row[hit], column[hit]]
        waiting &= ~hit
    image = torch.zeros_like(light)
    image[on_ground] = found
    return _smeared(image, on_ground, camera)


def _pixel(camera: Camera, ray: Float[Tensor, "rays 3"]) -> tuple[Tensor, Tensor, Tensor]:
    """Row and column that camera-frame points fall into, and whether they do."""
    depth = ray[:, 2].clamp_min(1e-3)
    column = (ray[:, 0] / depth * camera.fx_px + camera.cx_px).long()
    row = (ray[:, 1] / depth * camera.fy_px + camera.cy_px).long()
    inside = (row >= 0) & (row < camera.height_px) & (column >= 0) & (column < camera.width_px)
    inside &= ray[:, 2] > 1e-3
    return row.clamp(0, camera.height_px - 1), column.clamp(0, camera.width_px - 1), inside


def _smeared(
    image: Float[Tensor, "height width 3"], known: Bool[Tensor, "height width"], camera: Camera
) -> Float[Tensor, "height width 3"]:
    sigma_px = max(FILM_ROUGHNESS_RAD * camera.fy_px, 0.5)
    weight = known.numpy().astype(np.float32)
    blurred = cv2.GaussianBlur(image.numpy(), (0, 0), sigma_px / 4, sigmaY=sigma_px)
    share = cv2.GaussianBlur(weight, (0, 0), sigma_px / 4, sigmaY=sigma_px)
    return torch.from_numpy(blurred / np.maximum(share, 1e-3)[..., None])
