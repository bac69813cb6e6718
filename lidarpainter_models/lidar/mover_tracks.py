"""Clumps of moving points put together over time: who is who in the next frame.

Each track has a Kalman filter (Kalman, 1960) of place and velocity; clumps of a frame go to the
tracks that expect them (Kuhn, 1955). World, seen from above: x forward, y left; metres, seconds.
"""

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float
from scipy.optimize import linear_sum_assignment

from lidarpainter_models.lidar.moving_points import Clump

FIRST_SPEED_MPS = 12.0
"""Deviation of the speed of who is seen for the first time."""
ACCELERATION_MPS2 = 3.0
PLACE_M = 0.4
"""By how much the middle of what is seen of somebody jumps."""
GATE = 9.2
"""Squared deviations within which 99 of 100 clumps lie that are the track's own."""
LONGEST_UNSEEN_S = 0.65


class MoverTrack:
    """One thing that moves, clump by clump."""

    def __init__(self, clump: Clump) -> None:
        self.clumps = [clump]
        self._time_s = clump.time_ns * 1e-9
        self._state = np.zeros((2, 2))
        self._state[0] = middle(clump)
        self._covariance = np.diag([PLACE_M**2, FIRST_SPEED_MPS**2])

    def is_lost(self, now_s: float) -> bool:
        """Whether it was not seen for so long that who comes is another one."""
        return now_s - self._time_s > LONGEST_UNSEEN_S

    def surprise(self, clump: Clump) -> float:
        """Squared deviations of a clump from where the track expects one."""
        state, covariance = self._expected(clump)
        off_m = middle(clump) - state[0]
        return float(off_m @ off_m / (covariance[0, 0] + PLACE_M**2))

    def add(self, clump: Clump) -> None:
        """Take a clump as the next one."""
        state, covariance = self._expected(clump)
        gain = covariance[:, 0] / (covariance[0, 0] + PLACE_M**2)
        self._state = state + gain[:, None] * (middle(clump) - state[0])
        self._covariance = covariance - np.outer(gain, covariance[0])
        self._time_s = clump.time_ns * 1e-9
        self.clumps.append(clump)

    def _expected(self, clump: Clump) -> tuple[np.ndarray, np.ndarray]:
        return moved_on(self._state, self._covariance, clump.time_ns * 1e-9 - self._time_s)


def moved_on(
    state: Float[np.ndarray, "2 2"], covariance: Float[np.ndarray, "2 2"], seconds: float
) -> tuple[Float[np.ndarray, "2 2"], Float[np.ndarray, "2 2"]]:
    """Place and velocity (rows) after a time, under white noise of the acceleration."""
    step = np.array([[1.0, seconds], [0.0, 1.0]])
    kick = np.array([seconds**2 / 2, seconds])
    noise = ACCELERATION_MPS2**2 * np.outer(kick, kick)
    return step @ state, step @ covariance @ step.T + noise


def middle(clump: Clump) -> Float[np.ndarray, "2"]:
    """The middle of what is seen, from above."""
    low_m, high_m = np.percentile(clump.points_m[:, :2], [5, 95], axis=0)
    return np.asarray((low_m + high_m) / 2)


def tracked(frames: Mapping[int, Sequence[Clump]]) -> list[MoverTrack]:
    """Tracks of the clumps of all frames, in the order in which they begin."""
    done: list[MoverTrack] = []
    alive: list[MoverTrack] = []
    for _, clumps in sorted(frames.items()):
        if not clumps:
            continue
        now_s = min(clump.time_ns for clump in clumps) * 1e-9
        done += [track for track in alive if track.is_lost(now_s)]
        alive = [track for track in alive if not track.is_lost(now_s)]
        surprises = np.array([[one.surprise(clump) for clump in clumps] for one in alive])
        surprises = surprises.reshape(len(alive), len(clumps))
        rows, columns = linear_sum_assignment(np.minimum(surprises, 2 * GATE))
        free = set(range(len(clumps)))
        for row, column in zip(rows.tolist(), columns.tolist(), strict=True):
            if surprises[row, column] <= GATE:
                alive[row].add(clumps[column])
                free.discard(column)
        alive += [MoverTrack(clumps[column]) for column in sorted(free)]
    return done + alive
