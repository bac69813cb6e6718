"""Where the car really drove, beside where its recording says.

Recorded poses come from a filter over GNSS, wheels and inertia, which smooths away how a car
pitches and rolls on its springs. World: z up; metres, radians, float64.
"""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.geometry.transforms import rigid_from_tangent
from lidarpainter_models.scenes.records import RecordedView
from lidarpainter_models.scenes.tracks import ActorTrack

LEAST_TOLD_DEG = 0.01
"""A third of a pixel of an image with 2,000 pixels of focal length."""


@dataclass(frozen=True, kw_only=True, eq=False)
class EgoCorrections:
    """Small motions of everything that was recorded at a time, linear in between."""

    times_ns: Int[Tensor, " times"]
    """Ascending."""
    centre_m: Float[Tensor, "times 3"]
    """Where the car was recorded, about which it is turned."""
    tangent: Float[Tensor, "times 6"]
    """Rotation vector (radians) and translation (metres) in world axes."""

    @classmethod
    def none(cls) -> "EgoCorrections":
        """Poses are as recorded."""
        zeros = torch.zeros(0, 6, dtype=torch.float64)
        return cls(times_ns=zeros[:, 0].long(), centre_m=zeros[:, :3], tangent=zeros)

    def __len__(self) -> int:
        return len(self.times_ns)

    def in_words(self) -> list[str]:
        """What is worth telling of it, in sentences; nothing where poses were as good as right."""
        turn_deg = math.degrees(self.median_turn_rad)
        if turn_deg < LEAST_TOLD_DEG:
            return []
        return [
            f"The LiDAR sweeps say that the car was turned by {turn_deg:.2f} degrees (median) from "
            "its recorded poses; corrected."
        ]

    def at(self, timestamp_ns: int) -> Float[Tensor, "4 4"]:
        """What moves something recorded at a time to where it was; before and after as at the ends.

        Points, and poses from the left, are multiplied by it.
        """
        return self.at_times(torch.tensor([timestamp_ns]))[0]

    def at_times(self, timestamps_ns: Int[Tensor, " queries"]) -> Float[Tensor, "queries 4 4"]:
        """`at` many times."""
        if not len(self):
            return torch.eye(4, dtype=torch.float64).repeat(len(timestamps_ns), 1, 1)
        after = torch.searchsorted(self.times_ns, timestamps_ns).clamp(max=len(self) - 1)
        before = (after - 1).clamp(min=0)
        span_ns = (self.times_ns[after] - self.times_ns[before]).clamp(min=1)
        share = ((timestamps_ns - self.times_ns[before]).double() / span_ns).clamp(0, 1)[:, None]
        moved = rigid_from_tangent(torch.lerp(self.tangent[before], self.tangent[after], share))
        centre_m = torch.lerp(self.centre_m[before], self.centre_m[after], share)
        moved[:, :3, 3] += centre_m - (moved[:, :3, :3] @ centre_m[..., None])[..., 0]
        return moved

    def of_camera(self, camera: Camera, timestamp_ns: int) -> Camera:
        """A camera that recorded at a time, where it was."""
        if not len(self):
            return camera
        return replace(
            camera, world_from_camera=self.at(timestamp_ns) @ camera.world_from_camera.double()
        )

    def of_views(self, views: Iterable[RecordedView]) -> tuple[RecordedView, ...]:
        """Recorded views with their cameras where they were."""
        return tuple(
            replace(view, camera=self.of_camera(view.camera, view.timestamp_ns)) for view in views
        )

    def of_track(self, track: ActorTrack) -> ActorTrack:
        """An actor, whose boxes were drawn around the points of each time."""
        moved = self.at_times(track.timestamps_ns)
        return replace(track, world_from_box=moved @ track.world_from_box.double())

    @property
    def median_turn_rad(self) -> float:
        """By how much the car was recorded turned; an image is off by this times its focal length.

        0 where nothing was corrected.
        """
        return float(self.tangent[:, :3].norm(dim=1).median()) if len(self) else 0.0

    def tensors(self) -> dict[str, Tensor]:
        """Everything to be stored."""
        return {"times_ns": self.times_ns, "centre_m": self.centre_m, "tangent": self.tangent}

    @classmethod
    def from_tensors(cls, tensors: Mapping[str, Tensor]) -> "EgoCorrections":
        """Rebuild what was stored; nothing is what was stored before there were corrections."""
        return cls(**tensors) if tensors else cls.none()
