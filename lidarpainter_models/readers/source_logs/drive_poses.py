"""Poses and times along a drive, as every reader needs them."""

import math
from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from lidarpainter_models.geometry.timed_poses import poses_at
from lidarpainter_models.geometry.transforms import rigid_from_rotation, rotation_from_quaternion

NS_PER_S = 1_000_000_000
MIN_UNIT, MAX_UNIT = 0.99, 1.01
"""Length of a quaternion that a log may state; it is rounded to a few digits."""


def pose_at(
    global_from_body: Float[Tensor, "frames 4 4"], timestamps_ns: list[int], timestamp_ns: int
) -> Float[Tensor, "4 4"]:
    """A pose between the recorded ones; before the first and after the last the motion goes on."""
    return poses_at(global_from_body, np.array(timestamps_ns), np.array([timestamp_ns]))[0]


def level_frame(global_from_ego: Float[Tensor, "4 4"]) -> Float[Tensor, "4 4"]:
    """A frame at the ego's place whose x is its heading in the level plane and z is up."""
    heading_rad = torch.atan2(global_from_ego[1, 0], global_from_ego[0, 0])
    return turned_about_up(float(heading_rad), global_from_ego[:3, 3])


def turned_about_up(angle_rad: float, translation_m: Float[Tensor, "3"]) -> Float[Tensor, "4 4"]:
    """A frame at a place, turned counter-clockwise about the vertical."""
    cosine, sine = math.cos(angle_rad), math.sin(angle_rad)
    rotation = [[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]]
    return rigid_from_rotation(torch.tensor(rotation, dtype=torch.float64), translation_m)


def stated_pose(
    rotation_wxyz: Sequence[float], translation_m: Sequence[float]
) -> Float[Tensor, "4 4"] | None:
    """The pose that a log states, float64; None where the rotation is no unit quaternion."""
    rotation = torch.tensor(rotation_wxyz, dtype=torch.float64)
    if not MIN_UNIT < float(rotation.norm()) < MAX_UNIT:
        return None
    translation = torch.tensor(translation_m, dtype=torch.float64)
    return rigid_from_rotation(rotation_from_quaternion(rotation), translation)


def nanoseconds(time_s: float) -> int:
    """Seconds since the epoch as whole nanoseconds (a float64 holds them to 0.2 us)."""
    return round(time_s * NS_PER_S)
