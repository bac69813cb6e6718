"""A patterned wall seen from beside one another: depth from images has an exact answer."""

import torch
from gaussian_world import camera_at

from lidarpainter_models.geometry.cameras import Camera


def sideways_cameras(count=3, *, width_px=96, height_px=64):
    """Cameras 0.5 m apart, across their viewing direction."""
    base = camera_at(0.0, width_px=width_px, height_px=height_px)
    poses = []
    for step in range(count):
        pose = base.world_from_camera.clone()
        pose[1, 3] = 0.5 * step
        poses.append(base.at(pose))
    return poses


def image_of_wall(camera: Camera, wall_x_m: float):
    """A wall with a smooth pattern, seen exactly."""
    directions = camera.pixel_directions() @ camera.world_from_camera[:3, :3].float().T
    centre = camera.centre_world.float()
    points = centre + directions * ((wall_x_m - centre[0]) / directions[..., :1])
    y, z = points[..., 1], points[..., 2]
    return torch.stack([torch.sin(3 * y), torch.sin(4 * z + y), torch.cos(2 * y - z)], -1) / 2 + 0.5
