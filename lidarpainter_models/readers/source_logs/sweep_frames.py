"""Frames of a log whose clock is a LiDAR: which image a sweep gets, and points moved as the car.

Sensors run at their own rates. Every sweep is a frame; of each camera it has the image taken
nearest to its middle, if that is near enough.
"""

import numpy as np
import torch
from jaxtyping import Float, Float32, Float64, Int64
from torch import Tensor

from lidarpainter_models.readers.source_logs.drive_poses import poses_at

_KNOT_NS = 1_000_000
"""Between two poses a millisecond apart a point is mixed: a car that turns by 1 rad/s is off by
0.01 mm at 100 m."""


def nearest_images(
    sweeps_ns: Int64[np.ndarray, " sweeps"],
    images_ns: Int64[np.ndarray, " images"],
    *,
    reach_ns: int,
) -> Int64[np.ndarray, " sweeps"]:
    """For each sweep the image of one camera that is taken nearest to its middle.

    Args:
        sweeps_ns: middles of the sweeps, ascending.
        images_ns: when the images were taken, ascending.
        reach_ns: an image taken longer before or after is none of the sweep's.

    Returns:
        Positions of images, -1 where a sweep has none; an image that two sweeps are near to goes to
        the nearer one.
    """
    found = np.full(len(sweeps_ns), -1)
    if not len(images_ns):
        return found
    after = np.searchsorted(images_ns, sweeps_ns).clip(0, len(images_ns) - 1)
    before = (after - 1).clip(0)
    is_before = np.abs(images_ns[before] - sweeps_ns) <= np.abs(images_ns[after] - sweeps_ns)
    nearest = np.where(is_before, before, after)
    lag_ns = np.abs(images_ns[nearest] - sweeps_ns)
    best_ns = np.full(len(images_ns), np.iinfo(np.int64).max)
    np.minimum.at(best_ns, nearest, lag_ns)
    is_own = (lag_ns <= reach_ns) & (lag_ns == best_ns[nearest])
    found[is_own] = nearest[is_own]
    _, first = np.unique(found, return_index=True)  # of two sweeps as near to it the first has it
    keeps = np.zeros(len(found), dtype=bool)
    keeps[first] = True
    return np.where(keeps, found, -1)


def compensated(
    xyz_body_m: Float64[np.ndarray, "points 3"],
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
    if not len(times_ns):
        return torch.zeros(0, 3)
    first_ns, last_ns = int(times_ns.min()), int(times_ns.max())
    even_ns = np.arange(first_ns, last_ns + 2 * _KNOT_NS, _KNOT_NS, dtype=np.int64)
    own_ns = poses_ns[(poses_ns > first_ns) & (poses_ns < last_ns)]  # where the motion has a corner
    knots_ns = np.union1d(even_ns, own_ns)
    knots = poses_at(world_from_body, poses_ns, knots_ns).numpy()
    knot = np.searchsorted(knots_ns, times_ns, side="right") - 1
    share = ((times_ns - knots_ns[knot]) / (knots_ns[knot + 1] - knots_ns[knot]))[:, None]
    mixed = (1 - share) * _moved(knots[knot], xyz_body_m) + share * _moved(
        knots[knot + 1], xyz_body_m
    )
    return torch.from_numpy(mixed.astype(np.float32))


def _moved(poses: np.ndarray, xyz_m: np.ndarray) -> np.ndarray:
    return np.einsum("nij,nj->ni", poses[:, :3, :3], xyz_m) + poses[:, :3, 3]
