"""One frame on its way to the writer: from a reader, or from a scene that is written anew."""

from collections.abc import Sequence
from dataclasses import dataclass

from jaxtyping import Float, UInt8
from torch import Tensor

from lidarpainter_models.scenes.records import BoxRecord, ImageRecord, SweepPoints
from lidarpainter_models.scenes.writer import SceneWriter


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SourceImage:
    """An image, and the file it came from."""

    record: ImageRecord
    jpeg: bytes
    source: str


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SourceSweep:
    """A turn of a LiDAR, and the file it came from."""

    lidar_name: str
    points: SweepPoints
    timestamp_ns: int
    """Middle of the sweep."""
    world_from_lidar: Float[Tensor, "4 4"]
    semantics: UInt8[Tensor, " points"] | None = None
    source: str


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FrameContent:
    """Everything of one frame."""

    frame_index: int
    place: str
    """File or folder and frame, to name in errors."""
    timestamp_ns: int
    world_from_ego: Float[Tensor, "4 4"]
    images: Sequence[SourceImage]
    sweeps: Sequence[SourceSweep]
    boxes: Sequence[BoxRecord]

    def write(self, writer: SceneWriter) -> None:
        """Add the frame to a scene."""
        writer.add_frame(
            self.frame_index, timestamp_ns=self.timestamp_ns, world_from_ego=self.world_from_ego
        )
        for image in self.images:
            writer.add_image(image.record, image.jpeg, source=image.source)
        for sweep in self.sweeps:
            writer.add_sweep(
                sweep.lidar_name,
                sweep.points,
                timestamp_ns=sweep.timestamp_ns,
                world_from_lidar=sweep.world_from_lidar,
                semantics=sweep.semantics,
                source=sweep.source,
            )
        writer.add_boxes(self.boxes)
