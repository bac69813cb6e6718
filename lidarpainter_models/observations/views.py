"""What a fit sees of a scene: training images at fit size, sparse depth, sky masks, LiDAR map.

Frames: world (z up) and camera (x right, y down, z forward); metres.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

import torch
from jaxtyping import Bool, Float, Float16, UInt8
from torch import Tensor

from lidarpainter_models.devices import on_device
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.lidar.lidar_map import LidarMap
from lidarpainter_models.scenes.camera_faults import CameraFault
from lidarpainter_models.scenes.ego_corrections import EgoCorrections
from lidarpainter_models.scenes.records import ViewKey
from lidarpainter_models.scenes.tracks import ActorTrack


@dataclass(frozen=True, kw_only=True, eq=False)
class TrainingView:
    """One recorded image that a fit may use."""

    key: ViewKey
    camera: Camera
    """As recorded, faults corrected, at fit size."""
    timestamp_ns: int
    rgb_u8: UInt8[Tensor, "height width 3"]
    sky_mask: Bool[Tensor, "height width"]
    lidar_depth_m: Float[Tensor, "height width"]
    """The own frame's sweeps, 0 where no point falls."""
    hidden: Bool[Tensor, "height width"] | None = None
    """Where the image shows what the scene does not hold: the recording car itself, or what an edit
    took away. Nothing takes colours from there; the depths of LiDAR count. None hides nothing."""
    exposure_rgb: tuple[float, float, float] = (1.0, 1.0, 1.0)
    """What it shows of the map's colours, channel by channel: how its camera was exposed then."""

    @property
    def rgb(self) -> Float[Tensor, "height width 3"]:
        """The image as floats."""
        return self.rgb_u8.float() / 255

    @property
    def shows_surface(self) -> Bool[Tensor, "height width"]:
        """Where the image shows something of the scene that is not sky."""
        return ~self.sky_mask if self.hidden is None else ~(self.sky_mask | self.hidden)


@dataclass(frozen=True, kw_only=True, eq=False)
class GuidanceView:
    """One painted image of a view nobody recorded, kept no finer than it is exact."""

    camera: Camera
    """Where the image was painted; it is never corrected."""
    timestamp_ns: int
    rgb_u8: UInt8[Tensor, "height width 3"]
    weight_u8: UInt8[Tensor, "height width"]
    lidar_depth_f16: Float16[Tensor, "height width"]

    @classmethod
    def of(
        cls,
        camera: Camera,
        timestamp_ns: int,
        *,
        rgb: Float[Tensor, "height width 3"],
        weight: Float[Tensor, "height width"],
        lidar_depth_m: Float[Tensor, "height width"],
    ) -> "GuidanceView":
        """A view of floats; see the properties."""
        return cls(
            camera=camera,
            timestamp_ns=timestamp_ns,
            rgb_u8=_bytes(rgb),
            weight_u8=_bytes(weight),
            lidar_depth_f16=lidar_depth_m.half(),
        )

    @property
    def rgb(self) -> Float[Tensor, "height width 3"]:
        """The image as floats."""
        return self.rgb_u8.float() / 255

    @property
    def weight(self) -> Float[Tensor, "height width"]:
        """Confidence per pixel, 0 to 1."""
        return self.weight_u8.float() / 255

    @property
    def lidar_depth_m(self) -> Float[Tensor, "height width"]:
        """Sparse LiDAR depth in this view, 0 where there is none."""
        return self.lidar_depth_f16.float()

    @property
    def shows_surface(self) -> Bool[Tensor, "height width"]:
        """Where LiDAR hit something: of the rest nobody knows."""
        return self.lidar_depth_f16 > 0

    def to(self, device: torch.device) -> "GuidanceView":
        """The same view on another device, as far as it is not there."""
        return self if self.rgb_u8.device == device else on_device(self, device)


def _bytes(values: Float[Tensor, "*shape"]) -> UInt8[Tensor, "*shape"]:
    return (values.clamp(0, 1) * 255).round().to(torch.uint8)


@dataclass(frozen=True, kw_only=True, eq=False)
class SceneObservations:
    """All that a fit sees."""

    views: tuple[TrainingView, ...]
    lidar_map: LidarMap
    tracks: tuple[ActorTrack, ...]
    """Moving actors only."""
    path: EgoCorrections = field(default_factory=EgoCorrections.none)
    """Where the car drove beside what was recorded; views, map and tracks are moved there."""
    faults: Mapping[str, CameraFault] = field(default_factory=dict)
    """What was wrong about the cameras' recordings; the views are corrected already."""
    own_bodies: Mapping[str, Bool[Tensor, "height width"]] = field(default_factory=dict)
    """Where cameras show the recording car itself, at fit size."""
    is_estimated: bool = False
    """Whether points of the map were estimated from images, as the LiDAR tells too little."""

    @property
    def camera_names(self) -> tuple[str, ...]:
        """Cameras that have training views, sorted."""
        return tuple(sorted({view.key[1] for view in self.views}))
