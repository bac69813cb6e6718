"""Our point-cloud code beside open3d's: CPU seconds and how far the answers are apart.

    python tests/benchmarks/bench_point_clouds.py STORE/scenes/pandaset/002

The figures of docs/decisions/open3d.md come from it. One thread; the least of five runs.
"""

import os

os.environ |= {"OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}

import argparse
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import open3d
import torch
from scipy.spatial import KDTree

from lidarpainter_models.checks import sweep_agreement
from lidarpainter_models.gaussians.initialisation.adaptive_voxels import mean_by_voxel
from lidarpainter_models.gaussians.initialisation.surfels import neighbourhood, surface_axes
from lidarpainter_models.scenes.driving_scene import DrivingScene

K = 11
VOXEL_M = 0.1
NUM_RUNS = 5
MOVE_M = 0.2


def timed(run: Callable):
    """What a function gives, and the least CPU seconds of some runs."""
    seconds = []
    for _ in range(NUM_RUNS):
        start = time.process_time()
        found = run()
        seconds.append(time.process_time() - start)
    return found, min(seconds)


def cloud(xyz_m):
    return open3d.geometry.PointCloud(open3d.utility.Vector3dVector(np.asarray(xyz_m, np.float64)))


def nearest(xyz_m):
    search = open3d.core.nns.NearestNeighborSearch(open3d.core.Tensor(xyz_m))
    search.knn_index()
    index, squared = search.knn_search(open3d.core.Tensor(xyz_m), K)
    return index.numpy(), np.sqrt(squared.numpy())


def neighbours_row(xyz_m):
    (distance, _), ours_s = timed(lambda: neighbourhood(torch.from_numpy(xyz_m), K))
    (_, theirs), open3d_s = timed(lambda: nearest(xyz_m))
    apart = np.abs(distance.numpy() - theirs).max()
    return "11 nearest neighbours", ours_s, open3d_s, f"distances differ by up to {apart:.1e} m"


def normals_row(xyz_m):
    points = torch.from_numpy(xyz_m)

    def ours():
        _, index = neighbourhood(points, K)
        return surface_axes(points[index].double())[0][:, :, 0].numpy()

    def theirs():
        made = cloud(xyz_m)
        made.estimate_normals(open3d.geometry.KDTreeSearchParamKNN(K))
        return np.asarray(made.normals)

    (first, ours_s), (second, open3d_s) = timed(ours), timed(theirs)
    angle = np.degrees(np.arccos(np.abs((first * second).sum(axis=1)).clip(max=1)))
    share = (angle > 0.1).mean()
    return "normals", ours_s, open3d_s, f"{share:.2%} of them more than 0.1 degrees apart"


def voxels_row(xyz_m):
    points, count = torch.from_numpy(xyz_m), len(xyz_m)
    grey, known = torch.zeros(count, 3, dtype=torch.uint8), torch.zeros(count, dtype=torch.bool)
    sizes = torch.full((count,), VOXEL_M)
    first, ours_s = timed(lambda: mean_by_voxel(points, grey, known, sizes))
    low = np.floor(xyz_m.min(axis=0) / VOXEL_M) * VOXEL_M
    high = low + 1e4 * VOXEL_M
    second, open3d_s = timed(
        lambda: cloud(xyz_m).voxel_down_sample_and_trace(VOXEL_M, low - VOXEL_M / 2, high)[0]
    )
    apart = f"{len(first.xyz_m)} and {len(second.points)} voxels of {VOXEL_M} m"
    return "voxel means", ours_s, open3d_s, f"{apart}; theirs have one size, ours one per point"


def one_per_cell(points_m):
    """What the sweep check did before open3d: the first point in every cell."""
    cells = np.floor(points_m / 0.25).astype(np.int64)
    return points_m[np.unique(cells, axis=0, return_index=True)[1]]


def least_squares_plane(points_m):
    """What the doctor did before open3d: z = a x + b y + c with outliers dropped."""
    design = np.column_stack([points_m[:, :2], np.ones(len(points_m))])
    keep = points_m[:, 2] <= np.median(points_m[:, 2]) + 0.5
    for _ in range(5):
        plane, *_ = np.linalg.lstsq(design[keep], points_m[keep, 2], rcond=None)
        keep = np.abs(design @ plane - points_m[:, 2]) < 0.3
    return plane


def cells_row(xyz_m):
    points = xyz_m.astype(np.float64)
    first, ours_s = timed(lambda: one_per_cell(points))
    second, open3d_s = timed(lambda: cloud(points).voxel_down_sample(0.25))
    return "one point per cell", ours_s, open3d_s, f"{len(first)} and {len(second.points)} points"


def gap_row(first_m, second_m):
    first_m = sweep_agreement.some_of(first_m)
    first, ours_s = timed(lambda: float(np.median(KDTree(second_m).query(first_m)[0])))
    second, open3d_s = timed(
        lambda: float(np.median(cloud(first_m).compute_point_cloud_distance(cloud(second_m))))
    )
    return "gap between sweeps", ours_s, open3d_s, f"{first:.6f} and {second:.6f} m"


def icp_offset_m(first_m, second_m):
    """Median displacement by point-to-plane ICP with a robust kernel, from where the sweeps lie."""
    source, target = cloud(sweep_agreement.some_of(first_m)), cloud(second_m)
    target = target.voxel_down_sample(0.25)
    target.estimate_normals(open3d.geometry.KDTreeSearchParamKNN(8))
    registration = open3d.pipelines.registration
    loss = registration.TukeyLoss(k=0.1)
    found = registration.registration_icp(
        source,
        target,
        1.0,
        np.eye(4),
        registration.TransformationEstimationPointToPlane(loss),
    ).transformation
    points = np.asarray(source.points)
    moved = points @ found[:3, :3].T + found[:3, 3]
    return float(np.median(np.linalg.norm(moved - points, axis=1)))


def agreement_rows(first_m, second_m):
    half = second_m[second_m[:, 0] > np.median(second_m[:, 0])]
    cases = {"as recorded": (first_m, second_m, 0.0), "half of it silent": (first_m, half, 0.0)}
    for axis, name in enumerate("xyz"):
        moved_m = second_m + MOVE_M * np.eye(3)[axis]
        cases[f"moved along {name}"] = (first_m, moved_m, MOVE_M)
    cases["empty road"] = (empty_road(0), empty_road(1), 0.0)
    cases["empty road, lifted"] = (empty_road(0), empty_road(1) + MOVE_M * np.eye(3)[2], MOVE_M)
    for name, (one_m, other_m, true_m) in cases.items():
        ours, ours_s = timed(partial(sweep_agreement.sweep_offset_m, one_m, other_m))
        theirs, open3d_s = timed(partial(icp_offset_m, one_m, other_m))
        text = f"{ours:.3f} and {theirs:.3f} m, true {true_m:.1f} m"
        yield f"sweep offset, {name}", ours_s, open3d_s, text


def empty_road(seed):
    """Points at chance on a road between two walls: nothing says where along it they are."""
    generator = np.random.default_rng(seed)
    along, across = generator.uniform(-20, 20, 6000), generator.uniform(-8, 8, 6000)
    road = np.stack([along, across, np.zeros(6000)], axis=1)
    walls = np.stack([along, 8 * np.sign(across), generator.uniform(0, 6, 6000)], axis=1)
    return np.concatenate([road, walls])


def plane_row(xyz_m):
    low = xyz_m[np.abs(xyz_m[:, 2]) < 4]
    cells = np.floor(low[:, :2] / 2.0)
    order = np.lexsort((low[:, 2], cells[:, 1], cells[:, 0]))
    first_in_cell = np.r_[True, (np.diff(cells[order], axis=0) != 0).any(axis=1)]
    lowest = low[order[first_in_cell]]
    first, ours_s = timed(lambda: least_squares_plane(lowest))

    def theirs():
        open3d.utility.random.seed(0)
        a, b, c, d = cloud(lowest).segment_plane(0.3, 3, 1000)[0]
        return np.array([-a / c, -b / c, -d / c])

    second, open3d_s = timed(theirs)
    slopes = [np.degrees(np.arctan(np.hypot(*plane[:2]))) for plane in (first, second)]
    return "ground plane", ours_s, open3d_s, f"slope {slopes[0]:.2f} and {slopes[1]:.2f} degrees"


def main() -> None:
    """Print a row for each task."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scene", type=Path, help="folder of a stored scene")
    scene = DrivingScene.open(parser.parse_args().scene)
    near = []
    for frame, centre_m in zip(
        scene.frame_indices[:2], scene.world_from_ego[:2, :3, 3], strict=True
    ):
        near.append(sweep_agreement.points_near(scene.read_points(frame).xyz_m, centre_m))
    xyz_m = scene.read_points(scene.frame_indices[0]).xyz_m.numpy()
    ego_m = scene.world_from_ego[0, :3, 3].numpy()
    rows = [neighbours_row(xyz_m), normals_row(xyz_m), voxels_row(xyz_m), cells_row(near[0])]
    rows += [gap_row(*near), *agreement_rows(*near), plane_row(near[0] - ego_m)]
    counts = f"{len(xyz_m)} points, {len(near[0])} and {len(near[1])} within 25 m of the car"
    sys.stdout.write(counts + "\n")
    for name, ours_s, open3d_s, apart in rows:
        sys.stdout.write(f"| {name} | {ours_s:.3f} s | {open3d_s:.3f} s | {apart} |\n")


if __name__ == "__main__":
    main()
