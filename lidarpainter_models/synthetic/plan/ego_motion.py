"""How the recording car moves: along its lane, a little unsteady, never perfectly level."""

from dataclasses import dataclass, replace

import numpy as np

from lidarpainter_models.synthetic.plan.layout import StreetLine

SETTLING_S = 2.5


@dataclass(frozen=True, slots=True)
class Pace:
    """Speed that settles exponentially from a first to a last value; the first before time 0."""

    first_mps: float
    last_mps: float

    def speed_mps(self, time_s: np.ndarray | float) -> np.ndarray:
        """Speed at times after the start."""
        left = np.exp(-np.maximum(time_s, 0.0) / SETTLING_S)
        return np.asarray(self.last_mps + (self.first_mps - self.last_mps) * left)

    def travelled_m(self, time_s: np.ndarray | float) -> np.ndarray:
        """The integral of the speed."""
        since, before = np.maximum(time_s, 0.0), np.minimum(time_s, 0.0)
        settled = SETTLING_S * (1 - np.exp(-since / SETTLING_S))
        change = (self.first_mps - self.last_mps) * settled
        return np.asarray(self.first_mps * before + self.last_mps * since + change)

    def times(self, factor: float) -> "Pace":
        """The same course, faster or slower."""
        return Pace(self.first_mps * factor, self.last_mps * factor)


@dataclass(frozen=True, kw_only=True, eq=False)
class EgoMotion:
    """Pose of the ego frame (on the ground below the LiDAR) over time; the identity at time 0."""

    line: StreetLine
    pace: Pace
    sway_m: float
    sway_hz: float
    wobble_rad: tuple[float, float]
    """Amplitude of roll and pitch."""
    wobble_hz: tuple[float, float]
    phase_rad: tuple[float, float]

    def at_speed(self, first_mps: float, last_mps: float) -> "EgoMotion":
        """The same drive at another pace; a car that stands neither sways nor wobbles."""
        pace = Pace(first_mps, last_mps)
        if first_mps == last_mps == 0:
            return replace(self, pace=pace, sway_m=0.0, wobble_rad=(0.0, 0.0))
        return replace(self, pace=pace)

    def travelled_m(self, time_s: np.ndarray | float) -> np.ndarray:
        """Distance along the street."""
        return self.pace.travelled_m(time_s)

    def world_from_ego(self, time_s: np.ndarray) -> np.ndarray:
        """(n, 4, 4)."""
        swing = 2 * np.pi * self.sway_hz
        aside = self.sway_m * (1 - np.cos(swing * time_s))
        speed = np.maximum(self.pace.speed_mps(time_s), 0.5)
        yaw = np.arctan2(self.sway_m * swing * np.sin(swing * time_s), speed)
        poses = self.line.poses(self.travelled_m(time_s), aside, yaw)
        for axis in (0, 1):
            angle = self._wobble(time_s, axis)
            cosine, sine = np.cos(angle), np.sin(angle)
            turn = np.tile(np.eye(4), (time_s.size, 1, 1))
            first, second = ((1, 2), (2, 0))[axis]
            turn[:, first, first], turn[:, second, second] = cosine, cosine
            turn[:, second, first], turn[:, first, second] = sine, -sine
            poses = poses @ turn
        return poses

    def _wobble(self, time_s: np.ndarray, axis: int) -> np.ndarray:
        """Roll (0) or pitch (1), zero at time 0."""
        rate, phase = 2 * np.pi * self.wobble_hz[axis], self.phase_rad[axis]
        fast = np.sin(rate * time_s + phase) - np.sin(phase)
        slow = np.sin(0.37 * rate * time_s)
        return self.wobble_rad[axis] * (0.6 * fast + 0.4 * slow)


def draw_ego_motion(line: StreetLine, rng: np.random.Generator) -> EgoMotion:
    """A drive between 4 and 9 m/s."""
    return EgoMotion(
        line=line,
        pace=Pace(rng.uniform(4.0, 8.0), rng.uniform(5.0, 9.0)),
        sway_m=rng.uniform(-0.08, 0.08),
        sway_hz=rng.uniform(0.1, 0.25),
        wobble_rad=(rng.uniform(0.0005, 0.0015), rng.uniform(0.0008, 0.002)),
        wobble_hz=(rng.uniform(0.7, 1.4), rng.uniform(1.0, 1.9)),
        phase_rad=(rng.uniform(0, 6.28), rng.uniform(0, 6.28)),
    )
