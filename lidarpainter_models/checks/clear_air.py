"""Whether LiDAR met drops in the air."""

from typing import Literal

from lidarpainter_models.scenes.driving_scene import DrivingScene
from lidarpainter_models.scenes.lone_returns import WEATHER_REACH_M, is_confirmed

MOST_LONE = 0.025
"""Of the returns from where drops return; in dry air 0.002 to 0.004 stand alone at some edge, and
0.023 where a LiDAR fires once a degree."""
NEAREST_M = 3.0
"""Nearer returns may be of the car itself."""
NUM_FRAMES = 8


def check_clear_air(scene: DrivingScene) -> tuple[Literal["ok", "warn"], str]:
    """Whether few returns stand alone; a fit leaves these out."""
    step = len(scene.frame_indices) // NUM_FRAMES | 1  # odd, as every other frame may be unlike
    num_lone = num_near = 0
    for frame_index in scene.frame_indices[::step]:
        for sweep in scene.sweeps_of(frame_index):
            xyz_m = scene.read_column(sweep, "xyz_m")
            offset_m = xyz_m - sweep.world_from_lidar[:3, 3].to(xyz_m)
            range_m = offset_m.norm(dim=1)
            is_near = (range_m >= NEAREST_M) & (range_m <= WEATHER_REACH_M)
            num_near += int(is_near.sum())
            num_lone += int((is_near & ~is_confirmed(offset_m)).sum())
    share = num_lone / max(num_near, 1)
    found = f"{share:.1%} of the returns {NEAREST_M:g} to {WEATHER_REACH_M:g} m away stand alone"
    if share > MOST_LONE:
        return "warn", f"{found}, as of rain, snow or spray: they are left out"
    return "ok", found
