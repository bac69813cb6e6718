"""The sky as six pictures of a far cube, since the browser knows no sky texture.

World: z up. A picture's frame is that of a camera: x right, y down, z forward, through its middle.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from lidarpainter_models.gaussians.model.sky import SkyTexture
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.geometry.transforms import rigid_from_rotation

SKY_M = 5000.0
"""How far the cube's sides stand: a drive of 100 m moves the sky by a degree, and it is carried
along with the car."""
MOST_PX = 1024
"""Of a picture's side; sharper skies are made coarser."""
_FORWARD_AND_DOWN = {
    "front": ((1, 0, 0), (0, 0, -1)),
    "left": ((0, 1, 0), (0, 0, -1)),
    "back": ((-1, 0, 0), (0, 0, -1)),
    "right": ((0, -1, 0), (0, 0, -1)),
    "top": ((0, 0, 1), (1, 0, 0)),
    "bottom": ((0, 0, -1), (-1, 0, 0)),
}
"""World directions of every picture's z and y axes."""


@dataclass(frozen=True, kw_only=True, eq=False)
class SkyPanel:
    """One side of the cube."""

    name: str
    rgb: Float[Tensor, "side side 3"]
    world_from_panel: Float[Tensor, "3 3"]
    """A rotation."""


def sky_panels(sky: SkyTexture) -> list[SkyPanel]:
    """All six sides, as sharp in their middle as the texture is."""
    side_px = min(MOST_PX, math.ceil(2 / sky.layout.texel_rad))
    panels = []
    for name, (forward, down) in _FORWARD_AND_DOWN.items():
        z, y = torch.tensor(forward).double(), torch.tensor(down).double()
        rotation = torch.stack([torch.linalg.cross(y, z), y, z], dim=1)
        camera = Camera(
            world_from_camera=rigid_from_rotation(rotation, torch.zeros(3).double()),
            fx_px=side_px / 2,
            fy_px=side_px / 2,
            cx_px=side_px / 2,
            cy_px=side_px / 2,
            width_px=side_px,
            height_px=side_px,
        )
        rgb = sky.sample(sky.rays(camera))
        panels.append(SkyPanel(name=name, rgb=rgb, world_from_panel=rotation))
    return panels
