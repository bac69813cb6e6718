"""Assets on a turntable: pictures of Gaussians from all around, before plain grey.

Frame of an asset: x along its length, y left, z up, origin at the centre; metres.
"""

import math
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from lidarpainter_models.editing.actor_models import ActorModel
from lidarpainter_models.export.images import write_webp
from lidarpainter_models.gaussians.model.drawing import draw_gaussians
from lidarpainter_models.gaussians.model.gaussian_set import GaussianSet
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.geometry.transforms import invert_rigid

THUMBNAIL_FILE = "turntable.webp"
NUM_AZIMUTHS = 8
"""Pictures of an asset on its turntable, side by side before plain grey."""
WIDTH_PX, HEIGHT_PX = 128, 96
BACKGROUND = 0.75
_FOCAL_PX = 1.6 * WIDTH_PX


def write_turntable(output: Path, folder: str, model: ActorModel, *, elevation_deg: float) -> str:
    """Write the turntable of a model; its name in the artefact."""
    strip = turntable(model.gaussians, model.size_m, elevation_deg=elevation_deg)
    write_webp(strip, output / folder / THUMBNAIL_FILE)
    return f"{folder}/{THUMBNAIL_FILE}"


def turntable(
    gaussians: GaussianSet, size_m: Float[Tensor, "3"], *, elevation_deg: float = 15.0
) -> Float[Tensor, "height width 3"]:
    """See Gaussians (of body 0, about the origin) from all sides, first from ahead (+x).

    The azimuth grows to the left: ahead, ahead left, left, ... The camera is so far away that a
    box of this size fits.
    """
    pictures = []
    for number in range(NUM_AZIMUTHS):
        azimuth = 2 * math.pi * number / NUM_AZIMUTHS
        camera = camera_around(azimuth, math.radians(elevation_deg), size_m)
        bodies = invert_rigid(camera.world_from_camera)[None].float()
        with torch.no_grad():
            image = draw_gaussians(gaussians, bodies, camera)
        pictures.append(image.rgb.clamp(0, 1) + (1 - image.alpha)[..., None] * BACKGROUND)
    return torch.cat(pictures, dim=1).clamp(0, 1)


def camera_around(azimuth_rad: float, elevation_rad: float, size_m: Float[Tensor, "3"]) -> Camera:
    """A camera that looks at the origin from so far away that a box of this size fits."""
    distance_m = float(size_m.norm()) / 2 * math.hypot(1.0, 2 * _FOCAL_PX / HEIGHT_PX)
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
    return Camera.centred(pose, _FOCAL_PX, width_px=WIDTH_PX, height_px=HEIGHT_PX)
