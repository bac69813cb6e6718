"""A frame as it is stored, in parts that a fault may change."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import cv2
import numpy as np
from jaxtyping import Float
from torch import Tensor

from lidarpainter_models.errors import SceneError
from lidarpainter_models.geometry.transforms import interpolate_rigid_track, transform_points
from lidarpainter_models.scenes.driving_scene import DrivingScene
from lidarpainter_models.scenes.frame_content import FrameContent, SourceImage, SourceSweep
from lidarpainter_models.scenes.image_bytes import decode_image
from lidarpainter_models.scenes.records import BoxRecord, SweepPoints

JPEG_QUALITY = 95


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Frame(FrameContent):
    """Everything of one frame of a stored scene, and where the car was meanwhile."""

    position: int
    """Among the frames of the log."""
    pose_at: Callable[[int], Float[Tensor, "4 4"]]
    """`world_from_ego` at any time (ns) of the log; beyond its ends the end pose holds."""
    log_end_ns: int

    def moved(self, motion: Float[Tensor, "4 4"]) -> "Frame":
        """The frame as if the car had stood elsewhere: all that it saw moves with it.

        The motion is of the world, rigid, float64.
        """
        images = tuple(
            seen_from(image, motion @ image.record.camera.world_from_camera)
            for image in self.images
        )
        sweeps = tuple(
            replace(
                sweep,
                world_from_lidar=motion @ sweep.world_from_lidar,
                points=replace(
                    sweep.points,
                    xyz_m=transform_points(motion, sweep.points.xyz_m.double()).float(),
                ),
            )
            for sweep in self.sweeps
        )
        boxes = tuple(
            replace(box, world_from_box=motion @ box.world_from_box) for box in self.boxes
        )
        ego = motion @ self.world_from_ego
        return replace(self, world_from_ego=ego, images=images, sweeps=sweeps, boxes=boxes)


def with_pixels(image: SourceImage, change: Callable[[np.ndarray], np.ndarray]) -> SourceImage:
    """The same with its pixels changed: BGR in [0, 255], float32 (height, width, 3)."""
    bgr = decode_image(image.jpeg)
    if bgr is None:
        raise SceneError(f"an image of camera {image.record.camera_name} cannot be decoded")
    spoilt = change(bgr.astype(np.float32)).round().clip(0, 255).astype(np.uint8)
    encoded = cv2.imencode(".jpg", spoilt, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1]
    return replace(image, jpeg=encoded.tobytes())


def seen_from(image: SourceImage, world_from_camera: Float[Tensor, "4 4"]) -> SourceImage:
    """The same, said to be taken from elsewhere."""
    camera = replace(image.record.camera, world_from_camera=world_from_camera)
    return replace(image, record=replace(image.record, camera=camera))


def kept(sweep: SourceSweep, is_kept: Tensor) -> SourceSweep:
    """The points of a mask alone."""
    columns = {name: getattr(sweep.points, name) for name in SweepPoints.__dataclass_fields__}
    points = SweepPoints(**{name: column[is_kept] for name, column in columns.items()})
    semantics = None if sweep.semantics is None else sweep.semantics[is_kept]
    return replace(sweep, points=points, semantics=semantics)


def read_frame(scene: DrivingScene, frame_index: int) -> Frame:
    """Read a frame of a stored scene."""
    position, place = scene.frame_position(frame_index), f"{scene.path}, frame {frame_index}"
    semantics = scene.read_semantics(frame_index)
    sweeps = scene.sweeps_of(frame_index)
    counts = [sweep.num_points for sweep in sweeps]
    classes = [None] * len(sweeps) if semantics is None else list(semantics.split(counts))
    return Frame(
        frame_index=frame_index,
        place=place,
        position=position,
        timestamp_ns=int(scene.frame_timestamps_ns[position]),
        world_from_ego=scene.world_from_ego[position],
        pose_at=partial(interpolate_rigid_track, scene.frame_timestamps_ns, scene.world_from_ego),
        log_end_ns=int(scene.frame_timestamps_ns[-1]),
        images=tuple(
            SourceImage(record=scene.image_record(view), jpeg=scene.read_jpeg(view), source=place)
            for view in scene.views
            if view.frame_index == frame_index
        ),
        sweeps=tuple(
            SourceSweep(
                lidar_name=sweep.lidar_name,
                points=scene.read_sweep(sweep),
                timestamp_ns=sweep.timestamp_ns,
                world_from_lidar=sweep.world_from_lidar,
                semantics=classes[number],
                source=place,
            )
            for number, sweep in enumerate(sweeps)
        ),
        boxes=tuple(_boxes(scene, frame_index)),
    )


def _boxes(scene: DrivingScene, frame_index: int) -> list[BoxRecord]:
    found = []
    for track in scene.tracks:
        for row in (track.frame_indices == frame_index).nonzero()[:, 0].tolist():
            length_m, width_m, height_m = track.size_m.tolist()
            found.append(
                BoxRecord(
                    actor_id=track.actor_id,
                    category=track.category,
                    timestamp_ns=int(track.timestamps_ns[row]),
                    world_from_box=track.world_from_box[row],
                    size_m=(length_m, width_m, height_m),
                    is_moving=track.is_moving,
                    num_points=int(track.num_points[row]),
                )
            )
    return found
