"""Pictures of an asset on a turntable: several azimuths, side by side, before plain grey."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from lidarpainter_models.gaussians.model.gaussian_set import GaussianSet
from lidarpainter_models.gaussians.model.scene_rendering import draw_gaussians
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.geometry.transforms import invert_rigid

NUM_AZIMUTHS = 8
WIDTH_PX, HEIGHT_PX = 128, 96
BACKGROUND = 0.75
_FOCAL_PX = 1.6 * WIDTH_PX


def turntable(
    gaussians: GaussianSet, size_m: Float[Tensor, "3"], *, elevation_deg: float = 15.0
) -> Float[Tensor, "height width 3"]:
    """See Gaussians (of body 0, about the origin) from all sides, first from ahead (+x).

    The azimuth grows to the left: ahead, ahead left, left, ... The camera is so far away that a
    box of this size fits.
    """
    radius_m = float(size_m.norm()) / 2
    distance_m = radius_m * math.hypot(1.0, 2 * _FOCAL_PX / HEIGHT_PX)
    pictures = []
    for number in range(NUM_AZIMUTHS):
        azimuth = 2 * math.pi * number / NUM_AZIMUTHS
        camera = _looking_in(azimuth, math.radians(elevation_deg), distance_m)
        bodies = invert_rigid(camera.world_from_camera)[None].float()
        with torch.no_grad():
            image = draw_gaussians(gaussians, bodies, camera)
        pictures.append(image.rgb.clamp(0, 1) + (1 - image.alpha)[..., None] * BACKGROUND)
    return torch.cat(pictures, dim=1).clamp(0, 1)


def _looking_in(azimuth_rad: float, elevation_rad: float, distance_m: float) -> Camera:
    """A camera on a circle around the origin that looks at it."""
    flat = math.cos(elevation_rad)
    away = torch.tensor(
        [flat * math.cos(azimuth_rad), flat * math.sin(azimuth_rad), math.sin(elevation_rad)],
        dtype=torch.float64,
    )
    right = torch.tensor([-math.sin(azimuth_rad), math.cos(azimuth_rad), 0.0]).double()
    down = torch.linalg.cross(-away, right)
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = torch.stack([right, down, -away], dim=1)
    pose[:3, 3] = distance_m * away
    return Camera(
        world_from_camera=pose,
        fx_px=_FOCAL_PX,
        fy_px=_FOCAL_PX,
        cx_px=WIDTH_PX / 2,
        cy_px=HEIGHT_PX / 2,
        width_px=WIDTH_PX,
        height_px=HEIGHT_PX,
    )
