"""Where a body was at any time between its known poses, and points moved as it moved meanwhile.

A LiDAR takes a tenth of a second to turn: each of its points is of another pose.
"""

from collections.abc import Callable

import numpy as np
import torch
from jaxtyping import Float, Float32, Int64
from torch import Tensor

from lidarpainter_models.geometry.transforms import interpolate_rigid

_KNOT_NS = 1_000_000
"""Between two poses a millisecond apart a point is mixed: a car that turns by 1 rad/s is off by
0.01 mm at 100 m."""


def poses_at(
    global_from_body: Float[Tensor, "frames 4 4"],
    timestamps_ns: Int64[np.ndarray, " frames"],
    queries_ns: Int64[np.ndarray, " queries"],
) -> Float[Tensor, "queries 4 4"]:
    """Poses between the recorded ones, whose times ascend; beyond their ends the motion goes on."""
    if len(timestamps_ns) == 1:
        return global_from_body.expand(len(queries_ns), 4, 4)
    after = np.searchsorted(timestamps_ns, queries_ns).clip(1, len(timestamps_ns) - 1)
    start_ns, end_ns = timestamps_ns[after - 1], timestamps_ns[after]
    fraction = torch.from_numpy((queries_ns - start_ns) / (end_ns - start_ns))
    rows = torch.from_numpy(after)
    return interpolate_rigid(global_from_body[rows - 1], global_from_body[rows], fraction)


def compensated(
    xyz_body_m: Float[np.ndarray, "points 3"],
    times_ns: Int64[np.ndarray, " points"],
    world_from_body: Float[Tensor, "poses 4 4"],
    poses_ns: Int64[np.ndarray, " poses"],
) -> Float32[Tensor, "points 3"]:
    """Points in the world, each by the pose of its sensor at its own time.

    Args:
        xyz_body_m: each point in the sensor's frame at that time.
        times_ns: when each was measured.
        world_from_body: poses of the sensor, float64.
        poses_ns: their times, ascending.
    """
    moved_m = moved_meanwhile(
        xyz_body_m, times_ns, lambda at_ns: poses_at(world_from_body, poses_ns, at_ns), poses_ns
    )
    return torch.from_numpy(moved_m.astype(np.float32))


def moved_meanwhile(
    xyz_m: Float[np.ndarray, "points 3"],
    times_ns: Int64[np.ndarray, " points"],
    motion_at: Callable[[Int64[np.ndarray, " knots"]], Float[Tensor, "knots 4 4"]],
    corners_ns: Int64[np.ndarray, " corners"],
) -> Float[np.ndarray, "points 3"]:
    """Points, each moved by what a motion is at its own time; float64.

    Args:
        xyz_m: the points.
        times_ns: when each was measured.
        motion_at: the rigid transforms at some times, float64.
        corners_ns: where the motion has a corner, ascending.
    """
    if not len(times_ns):
        return np.zeros((0, 3))
    first_ns, last_ns = int(times_ns.min()), int(times_ns.max())
    even_ns = np.arange(first_ns, last_ns + 2 * _KNOT_NS, _KNOT_NS, dtype=np.int64)
    own_ns = corners_ns[(corners_ns > first_ns) & (corners_ns < last_ns)]
    knots_ns = np.union1d(even_ns, own_ns)
    knots = motion_at(knots_ns).numpy()
    knot = np.searchsorted(knots_ns, times_ns, side="right") - 1
    share = ((times_ns - knots_ns[knot]) / (knots_ns[knot + 1] - knots_ns[knot]))[:, None]
    return (1 - share) * _moved(knots[knot], xyz_m) + share * _moved(knots[knot + 1], xyz_m)


def _moved(poses: np.ndarray, xyz_m: np.ndarray) -> np.ndarray:
    return np.einsum("nij,nj->ni", poses[:, :3, :3], xyz_m) + poses[:, :3, 3]
