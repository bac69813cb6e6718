"""Where a sweep of a LiDAR could have hit an actor: its sector, its range, its lowest beam.

A LiDAR that looks ahead says nothing of a box behind it. What it covers is told by its points
alone: sectors of azimuth that hold some, the lowest elevation and the range of nearly all of them.
A sector in which nothing stands and no road is hit counts as not covered. There is no upper end:
actors stand on the road, and a box above the highest beam is a wrong one.
"""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from torch import Tensor

from lidarpainter_models.geometry.transforms import invert_rigid, transform_points
from lidarpainter_models.scenes.driving_scene import DrivingScene

_NUM_SECTORS = 120
"""Of three degrees: some firings fall into each of them, whatever the LiDAR."""
_FEW = 0.001
"""Of the points of a sweep: a single stray one does not widen what is covered."""


@dataclass(frozen=True, kw_only=True, eq=False)
class LidarReach:
    """What one sweep covered, seen from its LiDAR."""

    lidar_from_world: Float[Tensor, "4 4"]
    is_covered: Bool[np.ndarray, " sectors"]
    """By azimuth; a covered sector lies between two that hold points, too."""
    lowest_rad: float
    """Elevation of the lowest beam."""
    range_m: float

    @classmethod
    def of(
        cls, xyz_m: Float[Tensor, "points 3"], world_from_lidar: Float[Tensor, "4 4"]
    ) -> "LidarReach":
        """The reach of a sweep of at least one point in the world."""
        lidar_from_world = invert_rigid(world_from_lidar)
        away_m = transform_points(lidar_from_world.to(xyz_m), xyz_m).numpy()
        holds = np.zeros(_NUM_SECTORS, dtype=bool)
        holds[_sector(away_m)] = True
        range_m = np.linalg.norm(away_m, axis=1)
        elevation_rad = np.arcsin(np.clip(away_m[:, 2] / np.maximum(range_m, 1e-6), -1, 1))
        return cls(
            lidar_from_world=lidar_from_world,
            is_covered=holds & np.roll(holds, 1) & np.roll(holds, -1),
            lowest_rad=float(np.quantile(elevation_rad, _FEW)),
            range_m=float(np.quantile(range_m, 1 - _FEW)),
        )

    def covers(self, direction_world: Float[Tensor, "3"]) -> bool:
        """Whether a direction lies in the sector that was covered, at whatever elevation."""
        direction = self.lidar_from_world[:3, :3] @ direction_world
        return bool(self.is_covered[_sector(direction[None].numpy())[0]])

    def could_hit(self, world_from_box: Float[Tensor, "4 4"], size_m: Float[Tensor, "3"]) -> bool:
        """Whether the middle of a box lies in what was covered, its upper end at least."""
        centre_m = transform_points(self.lidar_from_world, world_from_box[None, :3, 3]).numpy()
        if np.linalg.norm(centre_m) > self.range_m or not self.is_covered[_sector(centre_m)[0]]:
            return False
        level_m = float(np.hypot(centre_m[0, 0], centre_m[0, 1]))
        top_m = float(centre_m[0, 2]) + float(size_m[2]) / 2
        return math.atan2(top_m, level_m) >= self.lowest_rad


def reaches_of(scene: DrivingScene, frame_index: int) -> list[LidarReach]:
    """What each sweep of a frame covered."""
    return [
        LidarReach.of(scene.read_column(sweep, "xyz_m"), sweep.world_from_lidar)
        for sweep in scene.sweeps_of(frame_index)
    ]


def could_any_hit(
    reaches: list[LidarReach], world_from_box: Float[Tensor, "4 4"], size_m: Float[Tensor, "3"]
) -> bool:
    """Whether one of a frame's sweeps could have hit a box."""
    return any(reach.could_hit(world_from_box, size_m) for reach in reaches)


def _sector(away_m: Float[np.ndarray, "points 3"]) -> np.ndarray:
    """Which sector of azimuth each point lies in."""
    share = (np.arctan2(away_m[:, 1], away_m[:, 0]) + np.pi) / (2 * np.pi)
    return np.minimum((share * _NUM_SECTORS).astype(int), _NUM_SECTORS - 1)
