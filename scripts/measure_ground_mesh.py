"""Measure the meshes of a scene against LiDAR sweeps that they were not made of.

    python scripts/measure_ground_mesh.py SCENE_FOLDER

Every tenth sweep of every LiDAR is held out. Heights are compared below held-out points that the
dataset itself calls road or ground; a hole is where such a point has no mesh below it.
"""

import sys
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from lidarpainter_models.lidar.ground_surface import GroundSurface, ground_surface
from lidarpainter_models.lidar.map_building import gather_points
from lidarpainter_models.scenes.driving_scene import DrivingScene, driven_road

HELD_OUT = 10
"""Every n-th sweep is held out."""
GROUND_CLASSES = ("Road", "Lane Line", "Stop Line", "Road Marking", "Ground", "Driveway", "road")
LANES_M = 5.25
"""The driven lane and those beside it reach so far to both sides of the path."""


def held_out_ground(scene: DrivingScene, frames: list[int]) -> np.ndarray:
    """Points (world) of some frames that the dataset itself calls ground."""
    names = scene.semantic_classes.items()
    wanted = [number for number, name in names if name.startswith(GROUND_CLASSES)]
    found = []
    for frame in frames:
        classes = scene.read_semantics(frame)
        if classes is None:
            raise SystemExit(f"{scene.path}: the points have no classes, so none is known as road")
        found.append(scene.read_positions(frame).numpy()[np.isin(classes.numpy(), wanted)])
    return np.concatenate(found)


def aside_m(xy_m: np.ndarray, path_xy: np.ndarray) -> np.ndarray:
    """How far places are from the path, straight on past its ends for 20 m."""
    ahead = path_xy[-1] - path_xy[0]
    ahead /= np.linalg.norm(ahead)
    ends = np.arange(0, 20, 0.5)[:, None] * ahead
    long = np.concatenate([path_xy[0] - ends[::-1], path_xy, path_xy[-1] + ends])
    dense = np.stack(
        [
            np.interp(np.linspace(0, len(long) - 1, 20 * len(long)), np.arange(len(long)), axis)
            for axis in long.T
        ],
        axis=1,
    )
    return cKDTree(dense).query(xy_m)[0]


def say(name: str, surface: GroundSurface, points_m: np.ndarray) -> None:
    """One line about the points of one part of the road."""
    below = surface.at(points_m[:, :2])
    error_m = np.abs(points_m[:, 2] - below)
    seen = np.isfinite(below)
    known = np.argwhere(np.isfinite(surface.height_m)) * surface.cell_m + surface.origin_m
    hole_m = 0.0
    if (~seen).any():
        hole_m = 2 * float(cKDTree(known).query(points_m[~seen][:, :2])[0].max())
    middle, most = np.quantile(error_m[seen], (0.5, 0.95))
    sys.stdout.write(
        f"{name}: {len(points_m)} points, median {100 * middle:.1f} cm, "
        f"mean {100 * error_m[seen].mean():.1f} cm, 95th percentile {100 * most:.1f} cm, "
        f"{np.mean(~seen):.3%} over holes, widest hole {hole_m:.2f} m\n"
    )


def main(folder: str) -> None:
    """Print how far the meshes are from what was held out."""
    scene = DrivingScene.open(Path(folder))
    held = scene.swept_frames[HELD_OUT // 2 :: HELD_OUT]
    used = [frame for frame in scene.swept_frames if frame not in held]
    street = gather_points(scene, used).street
    path = scene.world_from_ego[:, :3, 3].numpy()
    surface = ground_surface(street, driven_road(scene))
    points_m = held_out_ground(scene, held)
    aside = aside_m(points_m[:, :2], path[:, :2])
    sys.stdout.write(f"{len(used)} frames make the mesh, {len(held)} are held out\n")
    say("driven lane and those beside it", surface, points_m[aside < LANES_M])
    near = points_m[(aside >= LANES_M) & (aside < 20)]
    say("farther, up to 20 m", surface, near)


if __name__ == "__main__":
    main(sys.argv[1])
