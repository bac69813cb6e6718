"""A road between two walls, with exact depth, seen by a camera 1.6 m above it."""

import pytest
import torch

from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.painter.styles.view import StyleView

HEIGHT_PX, WIDTH_PX, FOCAL_PX = 90, 160, 120.0
CAMERA_HEIGHT_M, WALL_Y_M, WALL_TOP_M, END_M = 1.6, 6.0, 7.0, 60.0


def forward_camera():
    world_from_camera = torch.eye(4, dtype=torch.float64)
    world_from_camera[:3, :3] = torch.tensor([[0, 0, 1.0], [-1, 0, 0], [0, -1, 0]])
    world_from_camera[2, 3] = CAMERA_HEIGHT_M
    return Camera.centred(world_from_camera, FOCAL_PX, width_px=WIDTH_PX, height_px=HEIGHT_PX)


def street_view(*, with_camera=True):
    """Grey road, brown walls with dark windows, a wall across at 60 m, blue sky above."""
    camera = forward_camera()
    rays = camera.pixel_directions()  # x right, y down, z = 1
    beyond = torch.full(rays.shape[:2], torch.inf)
    road = torch.where(rays[..., 1] > 0, CAMERA_HEIGHT_M / rays[..., 1].clamp_min(1e-6), beyond)
    walls = WALL_Y_M / rays[..., 0].abs().clamp_min(1e-6)
    across = torch.full_like(beyond, END_M)
    depths = torch.stack([road, walls, across])
    heights = CAMERA_HEIGHT_M - rays[..., 1] * depths
    depths[heights > WALL_TOP_M] = torch.inf
    depth_m, which = depths.min(dim=0)
    sky = depth_m.isinf()
    colours = torch.tensor([[0.35, 0.35, 0.36], [0.55, 0.42, 0.35], [0.5, 0.5, 0.45]])
    rgb = colours[which]
    along = depth_m.nan_to_num(posinf=0.0)
    high = CAMERA_HEIGHT_M - rays[..., 1] * along
    pane = (which == 1) & (high > 3) & (high < 5) & (torch.remainder(along, 4.0) < 1.2)
    rgb = torch.where(pane[..., None], torch.tensor([0.12, 0.12, 0.14]), rgb)
    rgb = torch.where(sky[..., None], torch.tensor([0.62, 0.74, 0.9]), rgb)
    return StyleView(
        rgb=rgb,
        depth_m=torch.where(sky, 0.0, depth_m),
        sky=sky.float(),
        camera=camera if with_camera else None,
    )


@pytest.fixture(scope="session")
def street():
    return street_view()


@pytest.fixture(scope="session")
def street_without_camera():
    return street_view(with_camera=False)
