"""The line the street follows: gently curved, gently rising, with the ego lane's middle at d = 0.

Street coordinates are (s, d, h): metres along the line, to its left, above it. At s = 0 the line
passes the world's origin along +x, level.
"""

from dataclasses import dataclass

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
        start_m: float = -160.0,
        end_m: float = 460.0,
    ) -> "StreetLine":
        """A line whose curvature swings between +-`curvature_per_m`, rising up to 2 `rise_m`."""
        s = np.arange(start_m, end_m + STEP_M / 2, STEP_M)
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
        self,
        s_m: np.ndarray | float,
        d_m: np.ndarray | float,
        yaw_rad: np.ndarray | float = 0.0,
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
