"""The plan of a street, drawn from a seed: lanes, kerbs, cross street, sun.

Everything is in street coordinates (see street_line.py): d = 0 is the middle of the ego lane, left
is positive.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np

STEP_M = 0.5


@dataclass(frozen=True, eq=False)
class StreetLine:
    """Samples of the line every `STEP_M`."""

    s_m: np.ndarray
    x_m: np.ndarray
    y_m: np.ndarray
    z_m: np.ndarray
    heading_rad: np.ndarray

    @classmethod
    def curved(
        cls,
        *,
        curvature_per_m: float,
        wavelength_m: float,
        phase_rad: float,
        rise_m: float,
    ) -> "StreetLine":
        """A line whose curvature swings between +-`curvature_per_m`, rising up to 2 `rise_m`."""
        s = np.arange(-160.0, 460.0 + STEP_M / 2, STEP_M)
        curvature = curvature_per_m * np.sin(2 * np.pi * s / wavelength_m + phase_rad)
        zero = int(np.argmin(np.abs(s)))
        heading = _integral(curvature)
        heading -= heading[zero]
        x, y = _integral(np.cos(heading)), _integral(np.sin(heading))
        z = rise_m * (1 - np.cos(2 * np.pi * s / 240.0))
        return cls(s, x - x[zero], y - y[zero], z, heading)

    def heading_at(self, s_m: np.ndarray | float) -> np.ndarray | np.floating:
        """Direction of the line about the up axis, radians."""
        return np.asarray(np.interp(s_m, self.s_m, self.heading_rad))

    def place(
        self, s_m: np.ndarray | float, d_m: np.ndarray | float, h_m: np.ndarray | float = 0.0
    ) -> np.ndarray:
        """World positions (..., 3) of street coordinates."""
        s_m, d_m, h_m = np.broadcast_arrays(s_m, d_m, h_m)
        heading = self.heading_at(s_m)
        return np.stack(
            [
                np.interp(s_m, self.s_m, self.x_m) - np.sin(heading) * d_m,
                np.interp(s_m, self.s_m, self.y_m) + np.cos(heading) * d_m,
                np.interp(s_m, self.s_m, self.z_m) + h_m,
            ],
            axis=-1,
        )

    def poses(
        self, s_m: np.ndarray | float, d_m: np.ndarray | float, yaw_rad: np.ndarray | float = 0.0
    ) -> np.ndarray:
        """world_from_body (n, 4, 4) of things that stand on the street and follow its slope.

        Body frame: x along the street (turned by `yaw_rad`), y left, z up, origin on the ground.
        """
        s_m, d_m, yaw_rad = np.broadcast_arrays(np.atleast_1d(s_m), d_m, yaw_rad)
        heading = self.heading_at(s_m)
        slope = np.interp(s_m, self.s_m, np.gradient(self.z_m, self.s_m))
        ahead = np.stack([np.cos(heading), np.sin(heading), slope], axis=-1)
        ahead /= np.linalg.norm(ahead, axis=-1, keepdims=True)
        left = np.stack([-np.sin(heading), np.cos(heading), np.zeros_like(heading)], axis=-1)
        cosine, sine = np.cos(yaw_rad)[:, None], np.sin(yaw_rad)[:, None]
        poses = np.tile(np.eye(4), (s_m.size, 1, 1))
        poses[:, :3, 0] = cosine * ahead + sine * left
        poses[:, :3, 1] = -sine * ahead + cosine * left
        poses[:, :3, 2] = np.cross(ahead, left)
        poses[:, :3, 3] = self.place(s_m, d_m)
        return poses


def _integral(values: np.ndarray) -> np.ndarray:
    """Running trapezoid over the samples."""
    steps = (values[1:] + values[:-1]) / 2 * STEP_M
    return np.concatenate([[0.0], np.cumsum(steps)])


LANE_M = 3.5
PARKING_M = 2.3
SIDEWALK_M = 3.4
KERB_HEIGHT_M = 0.14
BLOCK_DEPTH_M = 75.0

RightSide = Literal["bike", "bus"]
LeftSide = Literal["lane", "turn"]


@dataclass(frozen=True, eq=False, kw_only=True)
class StreetPlan:
    """Where things are, before anything is built."""

    line: StreetLine
    right_side: RightSide
    """What runs between the ego lane and the parked cars."""
    left_side: LeftSide
    """What the lane left of the ego lane is for."""
    right_extra_m: float
    oncoming_d_m: tuple[float, ...]
    """Middles of the lanes with oncoming traffic."""
    centre_d_m: float
    """The double yellow line."""
    right_kerb_m: float
    left_kerb_m: float
    cross_start_m: float
    cross_end_m: float
    start_m: float
    end_m: float
    sun_direction: tuple[float, float, float]
    """Towards the sun, unit."""

    @property
    def parking_d_m(self) -> tuple[float, float]:
        """Middles of the right and the left row of parked cars."""
        return self.right_kerb_m + PARKING_M / 2 - 0.1, self.left_kerb_m - PARKING_M / 2 + 0.1

    @property
    def blocks(self) -> tuple[tuple[float, float], ...]:
        """Stretches (s from, to) between cross streets, where buildings stand."""
        return (self.start_m, self.cross_start_m), (self.cross_end_m, self.end_m)


def draw_plan(rng: np.random.Generator) -> StreetPlan:
    """A street unlike the last one."""
    line = StreetLine.curved(
        curvature_per_m=rng.uniform(0.0, 1 / 260.0) * rng.choice([-1, 1]),
        wavelength_m=rng.uniform(320, 520),
        phase_rad=rng.uniform(-0.6, 0.6),
        rise_m=rng.uniform(0.0, 0.55),
    )
    right_side: RightSide = "bike" if rng.random() < 0.5 else "bus"
    right_extra_m = 2.3 if right_side == "bike" else 3.4
    left_side: LeftSide = "lane" if rng.random() < 0.6 else "turn"
    centre_d_m = 1.5 * LANE_M + 0.1
    lanes = int(rng.integers(1, 3))
    oncoming = tuple(centre_d_m + 0.1 + LANE_M * (lane + 0.5) for lane in range(lanes))
    cross_start_m = rng.uniform(44, 62)
    azimuth = np.deg2rad(rng.uniform(55, 150) * rng.choice([-1, 1]))
    elevation = np.deg2rad(rng.uniform(36, 56))
    return StreetPlan(
        line=line,
        right_side=right_side,
        left_side=left_side,
        right_extra_m=right_extra_m,
        oncoming_d_m=oncoming,
        centre_d_m=centre_d_m,
        right_kerb_m=-(LANE_M / 2 + right_extra_m + PARKING_M),
        left_kerb_m=oncoming[-1] + LANE_M / 2 + PARKING_M,
        cross_start_m=cross_start_m,
        cross_end_m=cross_start_m + rng.uniform(11, 14),
        start_m=-110.0,
        end_m=330.0,
        sun_direction=(
            float(np.cos(elevation) * np.cos(azimuth)),
            float(np.cos(elevation) * np.sin(azimuth)),
            float(np.sin(elevation)),
        ),
    )
