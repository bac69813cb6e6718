"""A level road with a wall at its end and a car that drives along it, to be styled by hand."""

from dataclasses import replace

import torch
from gaussian_world import FRAME_NS, camera_at, car_track, round_gaussians, scene_of

from lidarpainter_models.gaussians.model.styling.scene_style import SceneStyle, StyledPlace
from lidarpainter_models.geometry.transforms import rigid_from_rotation
from lidarpainter_models.weather.mix import StyleMix

NUM_FRAMES = 4
STEP_M = 2.0
"""The car's way in a frame."""
START_M, CAR_Y_M = 8.0, -2.0
WALL_M = 30.0
ROAD_RGB, WALL_RGB, CAR_RGB = 0.45, 0.6, 0.3
CAR_SIZE_M = torch.tensor([4.4, 1.8, 1.5])


def car_ahead():
    """Drives along +x; the recording car stands at the origin."""
    poses = [
        rigid_from_rotation(
            torch.eye(3), torch.tensor([START_M + STEP_M * frame, CAR_Y_M, 0.75])
        ).double()
        for frame in range(NUM_FRAMES)
    ]
    return replace(car_track(NUM_FRAMES), size_m=CAR_SIZE_M, world_from_box=torch.stack(poses))


def _sheet(first, second, build, rgb, *, body=0):
    grid = torch.cartesian_prod(first, second)
    means = build(grid[:, 0], grid[:, 1])
    return round_gaussians(means, torch.full((len(grid), 3), rgb), sigma_m=0.3, body=body)


def clear_scene():
    """On a clear day, seen by a camera 1 m above the road."""
    road = _sheet(
        torch.arange(1.0, WALL_M, 0.5),
        torch.arange(-6.0, 6.1, 0.5),
        lambda x, y: torch.stack([x, y, torch.zeros_like(x)], dim=1),
        ROAD_RGB,
    )
    road.log_scale[:, 2] = torch.tensor(0.02).log()  # flat, so that it faces up
    wall = _sheet(
        torch.arange(-8.0, 8.1, 0.5),
        torch.arange(0.5, 6.1, 0.5),
        lambda y, z: torch.stack([torch.full_like(y, WALL_M), y, z], dim=1),
        WALL_RGB,
    )
    wall.log_scale[:, 0] = torch.tensor(0.02).log()
    car = _sheet(
        torch.arange(-2.0, 2.1, 0.5),
        torch.arange(-0.7, 0.8, 0.35),
        lambda x, y: torch.stack([x, y, torch.zeros_like(x)], dim=1),
        CAR_RGB,
        body=1,
    )
    cameras = [camera_at(0.0)] * NUM_FRAMES
    return scene_of(road.append(wall).append(car), cameras, [car_ahead()])


def place(**changes):
    """Known of that place: no lamp but those of cars; the recording car looks away from it."""
    nothing = {
        "white": torch.tensor(0.5),
        "horizon_light": torch.tensor([0.5, 0.55, 0.6]),
        "lamp_position": torch.zeros(0, 3),
        "lamp_rgb": torch.zeros(0, 3),
        "lamp_power": torch.zeros(0),
        "lamp_radiance": torch.zeros(0),
        "window_centre": torch.zeros(0, 3),
        "window_along": torch.zeros(0, 3),
        "window_half_m": torch.zeros(0, 2),
        "ego_times_ns": torch.arange(NUM_FRAMES) * FRAME_NS,
        "ego_lamp": torch.tensor([[0.0, 0.0, 0.65]]).repeat(NUM_FRAMES, 1),
        "ego_heading": torch.tensor([[-1.0, 0.0, 0.0]]).repeat(NUM_FRAMES, 1),
    }
    return StyledPlace(**(nothing | changes))


def styled(text, *, scene=None, **changes):
    """The scene in a style."""
    style = SceneStyle(mix=StyleMix.parse(text), seed=0, place=place(**changes))
    return replace(scene or clear_scene(), style=style)


def camera_above(x_m, height_m=30.0):
    """Looks straight down; the top of its image is ahead (+x)."""
    down = torch.tensor([[0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    turned = rigid_from_rotation(down, torch.tensor([x_m, 0.0, height_m]))
    return camera_at(0.0).at(turned.double())
