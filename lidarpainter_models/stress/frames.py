"""A frame as it is stored, in parts that a fault may change."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from torch import Tensor

from lidarpainter_models.errors import SceneError
from lidarpainter_models.geometry.transforms import interpolate_rigid_track, transform_points
from lidarpainter_models.scenes.driving_scene import DrivingScene
from lidarpainter_models.scenes.image_bytes import decode_image
from lidarpainter_models.scenes.records import BoxRecord, ImageRecord, Sweep, SweepPoints
from lidarpainter_models.scenes.rewriting import stored_content

JPEG_QUALITY = 95


@dataclass(frozen=True, kw_only=True, eq=False)
class Shot:
    """One image and what is said of it."""

    record: ImageRecord
    jpeg: bytes

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


@dataclass(frozen=True, kw_only=True, eq=False)
class Turn:
    """One sweep and its points."""

    sweep: Sweep
    points: SweepPoints
    semantics: UInt8[Tensor, " points"] | None = None

    def kept(self, is_kept: Tensor) -> "Turn":
        """The points of a mask alone."""
        columns = {name: getattr(self.points, name) for name in SweepPoints.__dataclass_fields__}
        points = SweepPoints(**{name: column[is_kept] for name, column in columns.items()})
        semantics = None if self.semantics is None else self.semantics[is_kept]
        return replace(self, points=points, semantics=semantics)


@dataclass(frozen=True, kw_only=True, eq=False)
class Frame:
    """Everything of one frame."""

    frame_index: int
    position: int
    """Among the frames of the log."""
    timestamp_ns: int
    world_from_ego: Float[Tensor, "4 4"]
    pose_at: Callable[[int], Float[Tensor, "4 4"]]
    """`world_from_ego` at any time (ns) of the log; beyond its ends the end pose holds."""
    log_end_ns: int
    shots: tuple[Shot, ...]
    turns: tuple[Turn, ...]
    boxes: tuple[BoxRecord, ...]

    def moved(self, motion: Float[Tensor, "4 4"]) -> "Frame":
        """The frame as if the car had stood elsewhere: all that it saw moves with it.

        The motion is of the world, rigid, float64.
        """
        shots = tuple(
            shot.seen_from(motion @ shot.record.camera.world_from_camera) for shot in self.shots
        )
        turns = tuple(
            replace(
                turn,
                sweep=replace(turn.sweep, world_from_lidar=motion @ turn.sweep.world_from_lidar),
                points=replace(
                    turn.points, xyz_m=transform_points(motion, turn.points.xyz_m.double()).float()
                ),
            )
            for turn in self.turns
        )
        boxes = tuple(
            replace(box, world_from_box=motion @ box.world_from_box) for box in self.boxes
        )
        ego = motion @ self.world_from_ego
        return replace(self, world_from_ego=ego, shots=shots, turns=turns, boxes=boxes)


def read_frame(scene: DrivingScene, frame_index: int) -> Frame:
    """Read a frame of a stored scene."""
    content = stored_content(scene, frame_index)
    return Frame(
        frame_index=frame_index,
        position=scene.frame_position(frame_index),
        timestamp_ns=content.timestamp_ns,
        world_from_ego=content.world_from_ego,
        pose_at=partial(interpolate_rigid_track, scene.frame_timestamps_ns, scene.world_from_ego),
        log_end_ns=int(scene.frame_timestamps_ns[-1]),
        shots=tuple(Shot(record=image.record, jpeg=image.jpeg) for image in content.images),
        turns=tuple(
            Turn(sweep=sweep, points=read.points, semantics=read.semantics)
            for sweep, read in zip(scene.sweeps_of(frame_index), content.sweeps, strict=True)
        ),
        boxes=tuple(content.boxes),
    )
