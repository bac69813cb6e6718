"""What a car meets on the driven road: ground, lanes, what stands beside it.

World frame, z up, metres. It is what a simulator is given in a bundle, and what the closed loop
drives on.
"""

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from lidarpainter_models.lidar.ground_surface import GroundSurface, ground_surface
from lidarpainter_models.lidar.lidar_map import MapPoints
from lidarpainter_models.lidar.map_building import gather_points
from lidarpainter_models.lidar.road_lanes import (
    Road,
    driven_line,
    driven_road_lanes,
    marking_points,
)
from lidarpainter_models.scenes.driving_scene import DrivingScene, driven_road

LEAST_HEIGHT_M, MOST_HEIGHT_M = 0.2, 6.0
"""What stands lower above the ground is driven over, what hangs higher is driven under."""
OBSTACLE_REACH_M = 40.0
"""Obstacles farther from the path are left out: nobody runs into them."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Surroundings:
    """The street of a log, for who drives there."""

    ground: GroundSurface
    street: MapPoints
    """Everything that stands still, the ground too."""
    road: Road

    def obstacle_points(self) -> Float[np.ndarray, "points 3"]:
        """Points (world) that stand on the ground, low enough to be run into."""
        filled, xyz_m = self.ground.everywhere(), self.street.xyz_m.double().numpy()
        path_m = self.road.line.xy_m
        low, high = path_m.min(axis=0) - OBSTACLE_REACH_M, path_m.max(axis=0) + OBSTACLE_REACH_M
        xyz_m = xyz_m[((xyz_m[:, :2] > low) & (xyz_m[:, :2] < high)).all(axis=1)]
        height_m = xyz_m[:, 2] - filled.at(xyz_m[:, :2])
        return xyz_m[(height_m > LEAST_HEIGHT_M) & (height_m < MOST_HEIGHT_M)]


def surroundings_of(
    scene: DrivingScene, frames: Collection[int], *, trusted_m: tuple[float, float]
) -> Surroundings:
    """Find ground and lanes of the driven road.

    Args:
        scene: the log, where its sweeps say that it was (`DrivingScene.corrected`).
        frames: whose sweeps may be used.
        trusted_m: how far to the left and to the right of the path the fitted scene is trusted.

    Raises:
        SceneError: the sweeps show no ground around the path.
    """
    path = driven_road(scene)
    street = gather_points(scene, frames).street
    ground = ground_surface(street, path)
    line = driven_line(path, ground)
    road = driven_road_lanes(
        line,
        marking_points(scene, frames, ground),
        ground,
        scene.tracks,
        path_length_m=float(path.travelled_m[-1]),
        trusted_m=trusted_m,
    )
    return Surroundings(ground=ground, street=street, road=road)
