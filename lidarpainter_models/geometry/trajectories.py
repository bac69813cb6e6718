"""Where a camera goes when nobody drove there: shifted copies of the recorded path.

Shifts are given in the road frame: forward along the path, left of it, up. World: z up.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from lidarpainter_models.errors import ConfigError
from lidarpainter_models.geometry.shifts import Shift
from lidarpainter_models.geometry.transforms import rigid_from_rotation, rotation_about_up

LEAST_TRAVEL_M = 1.0


def road_directions(world_from_ego: Float[Tensor, "frames 4 4"]) -> Float[Tensor, "frames 3"]:
    """Unit driving direction in the ground plane at every frame.

    The direction is the chord over at least `LEAST_TRAVEL_M` of path around the frame. A path that
    never travels so far (a car at a light) takes the heading of the ego frame itself (its x axis),
    so the result is defined when the car stands still.
    """
    positions = world_from_ego[:, :3, 3].clone()
    positions[:, 2] = 0
    heading = world_from_ego[:, :3, 0].clone()
    heading[:, 2] = 0
    heading = torch.nn.functional.normalize(heading, dim=-1)
    steps = (positions[1:] - positions[:-1]).norm(dim=-1)
    travelled = torch.cat([steps.new_zeros(1), steps.cumsum(0)])
    directions = heading.clone()
    for frame in range(len(positions)):
        before = int(torch.searchsorted(travelled, travelled[frame] - LEAST_TRAVEL_M / 2))
        after = int(torch.searchsorted(travelled, travelled[frame] + LEAST_TRAVEL_M / 2))
        chord = positions[min(after, len(positions) - 1)] - positions[max(before - 1, 0)]
        if chord.norm() >= LEAST_TRAVEL_M / 2:
            direction = chord / chord.norm()
            # driving backwards keeps the side that is left of the car on the left
            directions[frame] = direction if direction @ heading[frame] >= 0 else -direction
    return directions


def shift_pose(
    world_from_camera: Float[Tensor, "4 4"], road_direction: Float[Tensor, "3"], shift: Shift
) -> Float[Tensor, "4 4"]:
    """The camera pose moved sideways and up relative to the road, and turned about up."""
    up = torch.tensor([0.0, 0.0, 1.0], dtype=world_from_camera.dtype)
    left = torch.linalg.cross(up, road_direction.to(world_from_camera))
    if left.norm() < 1e-6:
        raise ConfigError("the road direction is vertical: no lateral direction is defined")
    offset = shift.lateral_m * left / left.norm() + shift.up_m * up
    turn = rotation_about_up(torch.tensor(shift.yaw_rad, dtype=world_from_camera.dtype))
    return rigid_from_rotation(turn @ world_from_camera[:3, :3], world_from_camera[:3, 3] + offset)
