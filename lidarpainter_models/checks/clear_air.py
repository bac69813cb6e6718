"""Whether LiDAR met drops in the air."""

from typing import Literal

from lidarpainter_models.scenes.driving_scene import DrivingScene
from lidarpainter_models.scenes.lone_returns import WEATHER_REACH_M, is_confirmed, stands_alone

MOST_LEFT_OUT = 0.025
"""Of the returns from where drops return; in dry air 0.023 where a LiDAR fires once a degree."""
NEAREST_M = 3.0
"""Nearer returns may be of the car itself."""
NUM_FRAMES = 8


def check_clear_air(scene: DrivingScene) -> tuple[Literal["ok", "warn"], str]:
    """Whether a fit keeps the returns, or leaves out many that stand alone."""
    step = len(scene.frame_indices) // NUM_FRAMES | 1  # odd, as every other frame may be unlike
    num_near = num_lone = num_left_out = 0
    for frame_index in scene.frame_indices[::step]:
        for sweep in scene.sweeps_of(frame_index):
            xyz_m = scene.read_column(sweep, "xyz_m")
            offset_m = xyz_m - sweep.world_from_lidar[:3, 3].to(xyz_m)
            range_m = offset_m.norm(dim=1)
            is_near = (range_m >= NEAREST_M) & (range_m <= WEATHER_REACH_M)
            num_near += int(is_near.sum())
            num_lone += int((is_near & stands_alone(offset_m)).sum())
            num_left_out += int((is_near & ~is_confirmed(offset_m)).sum())
    reach = f"of the returns {NEAREST_M:g} to {WEATHER_REACH_M:g} m away"
    found = f"{num_lone / max(num_near, 1):.1%} {reach} stand alone"
    if num_left_out > MOST_LEFT_OUT * num_near:
        return "warn", f"{found}, as of rain, snow or spray: they are left out"
    return "ok", f"{found}: they are left out where they are many" if num_left_out else found
