"""What is wrong about a camera's recording, and the recording put right.

Camera frame: x right, y down, z forward.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import torch

from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.geometry.transforms import rigid_from_tangent


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraFault:
    """How a camera departs from what is stored about it; 0 where nothing was found."""

    turn_rad: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """From where it is said to look to where it looks, about its own axes."""
    late_s: float = 0.0
    """How much after their timestamps its images were taken."""
    readout_s: float = 0.0
    """From its first row read to the last, downwards, where the recording does not tell."""

    def corrected(self, camera: Camera) -> Camera:
        """A recorded camera where and as it really took its image."""
        if camera.shutter is None:
            return camera
        across_s = (0.0, self.readout_s) if self.readout_s else camera.shutter.across_s
        shutter = replace(camera.shutter, across_s=across_s, late_s=self.late_s)
        turn = torch.tensor([*self.turn_rad, 0.0, 0.0, 0.0], dtype=torch.float64)
        moved = rigid_from_tangent(self.late_s * shutter.twist_per_s)
        pose = camera.world_from_camera.double() @ moved @ rigid_from_tangent(turn)
        return replace(camera, world_from_camera=pose, shutter=shutter)

    def __str__(self) -> str:
        """In words, to follow the camera's name."""
        said = []
        if self.late_s:
            when = "late" if self.late_s > 0 else "early"
            said.append(f"is {1e3 * abs(self.late_s):.0f} ms {when}")
        if any(self.turn_rad):
            pitch, yaw, roll = (math.degrees(angle) for angle in self.turn_rad)
            parts = [(abs(yaw), "right" if yaw > 0 else "left")]
            parts += [(abs(pitch), "up" if pitch > 0 else "down")]
            parts += [(abs(roll), "clockwise" if roll > 0 else "counter-clockwise")]
            least = max(degrees for degrees, _ in parts) / 4
            turns = [f"{degrees:.2f} degrees {way}" for degrees, way in parts if degrees >= least]
            said.append(f"looks {' and '.join(turns)} of its calibration")
        if self.readout_s:
            way = "down" if self.readout_s > 0 else "up"
            said.append(f"reads its rows {way} in {1e3 * abs(self.readout_s):.0f} ms")
        return ", ".join(said)


def faults_from_records(records: Mapping[str, Mapping[str, Any]]) -> dict[str, CameraFault]:
    """Faults by camera from what `asdict` made of each, lists for tuples."""
    return {
        name: CameraFault(**{**record, "turn_rad": tuple(record["turn_rad"])})
        for name, record in records.items()
    }
