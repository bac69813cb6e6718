"""What a scene is made of, in memory: images, sweeps and boxes with their times and poses.

World: x forward, y left, z up. Poses are float64 at the time stated beside them; points are
float32, already motion-compensated to the world.
"""

from dataclasses import dataclass, field
from typing import Literal

import torch
from jaxtyping import Float, Int, Integer, Shaped
from torch import Tensor

from lidarpainter_models.errors import DataError
from lidarpainter_models.geometry.cameras import Camera

ViewKey = tuple[int, str]
"""Frame index and camera name."""

_TERM_COUNTS: dict[str, tuple[int, ...]] = {
    "none": (0,),
    "brown": (4, 5, 8),
    "fisheye": (4,),
    "mei": (5,),
}


@dataclass(frozen=True, slots=True)
class Distortion:
    """How a lens departs from a pinhole; models and terms as OpenCV defines them."""

    model: str = "none"
    """none, brown, fisheye or mei."""
    terms: tuple[float, ...] = ()
    """brown: k1 k2 p1 p2 [k3 [k4 k5 k6]]; fisheye: k1 k2 k3 k4; mei: xi k1 k2 p1 p2."""

    def __post_init__(self) -> None:
        if self.model not in _TERM_COUNTS:
            raise DataError(
                f"distortion model {self.model!r} is not known, expected one of "
                f"{', '.join(_TERM_COUNTS)}"
            )
        if len(self.terms) not in _TERM_COUNTS[self.model]:
            raise DataError(
                f"distortion model {self.model!r} takes "
                f"{' or '.join(map(str, _TERM_COUNTS[self.model]))} terms, got {len(self.terms)}"
            )


@dataclass(frozen=True, slots=True, kw_only=True)
class RollingShutter:
    """How a sensor reads its rows."""

    duration_s: float
    """From the first row read to the last."""
    direction: Literal["down", "up", "left", "right"]
    first_row_s: float | None = None
    """When the first row is read, after the image's timestamp; None where the timestamp is that of
    the middle row."""

    @property
    def middle_s(self) -> float:
        """When the middle row is read, after the image's timestamp."""
        return 0.0 if self.first_row_s is None else self.first_row_s + self.duration_s / 2


@dataclass(frozen=True, kw_only=True, eq=False)
class ImageRecord:
    """One image to be stored: which camera took it, when, where and through which lens."""

    camera_name: str
    timestamp_ns: int
    camera: Camera
    """At the timestamp, on the grid of the stored image (distortion not yet undone)."""
    distortion: Distortion = field(default_factory=Distortion)
    rolling_shutter: RollingShutter | None = None


@dataclass(frozen=True, kw_only=True, eq=False)
class BoxRecord:
    """One box of one frame to be stored."""

    actor_id: str
    category: str
    timestamp_ns: int
    world_from_box: Float[Tensor, "4 4"]
    size_m: tuple[float, float, float]
    """Length, width, height."""
    is_moving: bool
    num_points: int


@dataclass(frozen=True, kw_only=True, eq=False)
class RecordedView:
    """One recorded image; `DrivingScene.read_image` gives its pixels."""

    frame_index: int
    camera_name: str
    timestamp_ns: int
    """When the middle row was read."""
    camera: Camera
    """At that time and full size; where the lens is distorted, that of the undistorted image."""
    index: int
    """Row in the table of images."""

    @property
    def key(self) -> ViewKey:
        """Names the view within its scene."""
        return self.frame_index, self.camera_name


@dataclass(frozen=True, kw_only=True, eq=False)
class Sweep:
    """One turn of one LiDAR; `DrivingScene.read_sweep` gives its points."""

    frame_index: int
    lidar_name: str
    timestamp_ns: int
    """Middle of the sweep; each point adds its own offset."""
    world_from_lidar: Float[Tensor, "4 4"]
    """At the timestamp; the origin is where the rays start."""
    offset: int
    num_points: int


@dataclass(frozen=True, kw_only=True, eq=False)
class SweepPoints:
    """LiDAR points in the world."""

    xyz_m: Float[Tensor, "points 3"]
    intensity: Float[Tensor, " points"]
    time_offset_ns: Int[Tensor, " points"]
    """After the time of the sweep."""
    ring: Int[Tensor, " points"]
    """Laser of the sensor, -1 where unknown."""
    return_index: Integer[Tensor, " points"]
    lidar: Shaped[Tensor, " points"]
    """Position of the LiDAR's name in the scene's `lidar_names`."""

    @classmethod
    def of(
        cls,
        xyz_m: Float[Tensor, "points 3"],
        *,
        intensity: Float[Tensor, " points"] | None = None,
        time_offset_ns: Int[Tensor, " points"] | None = None,
        ring: Int[Tensor, " points"] | None = None,
        return_index: Integer[Tensor, " points"] | None = None,
    ) -> "SweepPoints":
        """The points of one LiDAR, which the writer names; what is not known may be left out."""
        count = len(xyz_m)
        unmeasured = torch.zeros(count, dtype=torch.int32)
        return cls(
            xyz_m=xyz_m,
            intensity=torch.zeros(count) if intensity is None else intensity,
            time_offset_ns=unmeasured if time_offset_ns is None else time_offset_ns,
            ring=torch.full((count,), -1, dtype=torch.int16) if ring is None else ring,
            return_index=(
                torch.zeros(count, dtype=torch.int8) if return_index is None else return_index
            ),
            lidar=torch.zeros(count, dtype=torch.uint8),
        )

    @property
    def num_points(self) -> int:
        """How many points there are."""
        return self.xyz_m.shape[0]

    @classmethod
    def concatenate(cls, parts: list["SweepPoints"]) -> "SweepPoints":
        """All points of several sweeps; time offsets stay relative to each one's own sweep."""
        return cls(
            **{
                name: torch.cat([getattr(part, name) for part in parts])
                for name in cls.__dataclass_fields__
            }
        )
