"""Measure the meshes of a scene against LiDAR sweeps that they were not made of.

    python scripts/measure_ground_mesh.py SCENE_FOLDER

Every tenth sweep of every LiDAR is held out. Heights are compared below held-out points that the
dataset itself calls road or ground; a hole is where such a point has no mesh below it.
"""

import sys
from pathlib import Path
from typing import Any

import numpy as np
import open3d
from scipy.spatial import cKDTree

from lidarpainter_models.export.meshes import obstacle_mesh
from lidarpainter_models.lidar.ground_surface import GroundSurface
from lidarpainter_models.lidar.surroundings import Surroundings, surroundings_of
from lidarpainter_models.scenes.driving_scene import DrivingScene

HELD_OUT = 10
"""Every n-th sweep is held out."""
GROUND_CLASSES = ("Road", "Lane Line", "Stop Line", "Road Marking", "Ground", "Driveway", "road")
LANES_M = 5.25
"""The driven lane and those beside it reach so far to both sides of the path."""


STANDING_CLASSES = ("Building", "Signs", "Other Static", "Vegetation", "Pylons", "Road Barriers")


def points_called(scene: DrivingScene, frames: list[int], called: tuple[str, ...]) -> np.ndarray:
    """Points (world) of some frames whose class, by the dataset itself, begins so."""
    names = scene.semantic_classes.items()
    wanted = [number for number, name in names if name.startswith(called)]
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


def say_obstacles(around: Surroundings, points_m: np.ndarray) -> None:
    """One line about how far the collision mesh is from held-out points on what stands."""
    made_of = around.obstacle_points()
    vertices, faces = obstacle_mesh(made_of, np.array([0.0, 0.0, 2.0]))
    tensor: Any = open3d.core.Tensor
    scene = open3d.t.geometry.RaycastingScene()
    scene.add_triangles(tensor(vertices), tensor(faces.astype(np.uint32)))
    low, high = made_of.min(axis=0) + 2, made_of.max(axis=0) - 2
    height_m = points_m[:, 2] - around.ground.everywhere().at(points_m[:, :2])
    is_in = ((points_m[:, :2] > low[:2]) & (points_m[:, :2] < high[:2])).all(axis=1)
    judged = points_m[is_in & (height_m > 0.25) & (height_m < 5.5)][::5]
    away_m = scene.compute_distance(tensor(judged.astype(np.float32))).numpy()
    middle, most = np.quantile(away_m, (0.5, 0.95))
    sys.stdout.write(
        f"obstacles: {len(faces)} faces, {len(judged)} held-out points, median "
        f"{100 * middle:.1f} cm, mean {100 * away_m.mean():.1f} cm, "
        f"95th percentile {100 * most:.1f} cm\n"
    )


def main(folder: str) -> None:
    """Print how far the meshes are from what was held out."""
    scene = DrivingScene.open(Path(folder))
    held = scene.swept_frames[HELD_OUT // 2 :: HELD_OUT]
    used = [frame for frame in scene.swept_frames if frame not in held]
    around = surroundings_of(scene, used, trusted_m=(0.0, 0.0))
    path, surface = scene.world_from_ego[:, :3, 3].numpy(), around.ground
    points_m = points_called(scene, held, GROUND_CLASSES)
    aside = aside_m(points_m[:, :2], path[:, :2])
    sys.stdout.write(f"{len(used)} frames make the mesh, {len(held)} are held out\n")
    say("driven lane and those beside it", surface, points_m[aside < LANES_M])
    near = points_m[(aside >= LANES_M) & (aside < 20)]
    say("farther, up to 20 m", surface, near)
    say_obstacles(around, points_called(scene, held, STANDING_CLASSES))


if __name__ == "__main__":
    main(sys.argv[1])
