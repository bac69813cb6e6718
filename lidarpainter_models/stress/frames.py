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
from lidarpainter_models.scenes.frame_content import FrameContent, SourceImage
from lidarpainter_models.scenes.image_bytes import decode_image
from lidarpainter_models.scenes.rewriting import stored_content

JPEG_QUALITY = 95


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Shot(SourceImage):
    """One image and what is said of it."""

    def with_pixels(self, change: Callable[[np.ndarray], np.ndarray]) -> "Shot":
        """The same with its pixels changed: BGR in [0, 255], float32 (height, width, 3)."""
        bgr = decode_image(self.jpeg)
        if bgr is None:
            raise SceneError(f"an image of camera {self.record.camera_name} cannot be decoded")
        spoilt = change(bgr.astype(np.float32)).round().clip(0, 255).astype(np.uint8)
        encoded = cv2.imencode(".jpg", spoilt, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1]
        return replace(self, jpeg=encoded.tobytes())

    def seen_from(self, world_from_camera: Float[Tensor, "4 4"]) -> "Shot":
        """The same, said to be taken from elsewhere."""
        camera = replace(self.record.camera, world_from_camera=world_from_camera)
        return replace(self, record=replace(self.record, camera=camera))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Frame(FrameContent):
    """Everything of one frame, and where the car was around it."""

    images: tuple[Shot, ...]
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
            shot.seen_from(motion @ shot.record.camera.world_from_camera) for shot in self.images
        )
        sweeps = []
        for sweep in self.sweeps:
            xyz_m = transform_points(motion, sweep.points.xyz_m.double()).float()
            points, pose = replace(sweep.points, xyz_m=xyz_m), motion @ sweep.world_from_lidar
            sweeps.append(replace(sweep, points=points, world_from_lidar=pose))
        boxes = [replace(box, world_from_box=motion @ box.world_from_box) for box in self.boxes]
        ego = motion @ self.world_from_ego
        return replace(self, world_from_ego=ego, images=images, sweeps=sweeps, boxes=boxes)


def read_frame(scene: DrivingScene, frame_index: int) -> Frame:
    """Read a frame of a stored scene."""
    content = stored_content(scene, frame_index)
    return Frame(
        frame_index=frame_index,
        place=content.place,
        timestamp_ns=content.timestamp_ns,
        world_from_ego=content.world_from_ego,
        # without a source: what is wrong with a spoilt frame, the writer names by its own place
        images=tuple(Shot(record=one.record, jpeg=one.jpeg, source="") for one in content.images),
        sweeps=tuple(replace(sweep, source="") for sweep in content.sweeps),
        boxes=tuple(content.boxes),
        position=scene.frame_position(frame_index),
        pose_at=partial(interpolate_rigid_track, scene.frame_timestamps_ns, scene.world_from_ego),
        log_end_ns=int(scene.frame_timestamps_ns[-1]),
    )
