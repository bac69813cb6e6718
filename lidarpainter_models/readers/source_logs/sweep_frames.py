"""Frames of a log whose clock is a LiDAR: which image a sweep gets.

Sensors run at their own rates. Every sweep is a frame; of each camera it has the image taken
nearest to its middle, if that is near enough.
"""

import numpy as np
from jaxtyping import Int64


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
