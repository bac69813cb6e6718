"""A real frame without range images, which is no scene, decoded and drawn all the same.

    PYTHONPATH=.:tests/support python tests/support/waymo_real.py FRAME.tfrecord IMAGE.jpg

draws the labels of the frame over its FRONT image: that is how docs/pictures/overlay_waymo.jpg
was made. The messages are also read here without the reader's schema, to check the one against
the other.
"""

import sys
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from waymo_edits import split

from lidarpainter_models.checks.overlay import draw_boxes
from lidarpainter_models.geometry.transforms import invert_rigid
from lidarpainter_models.readers.waymo.boxes import FramePoints, box_records
from lidarpainter_models.readers.waymo.cameras import exposure_s, image_record
from lidarpainter_models.readers.waymo.log import WaymoFrame, WaymoImage
from lidarpainter_models.readers.waymo.tfrecord import WaymoRecordSegment
from lidarpainter_models.scenes.tracks import ActorTrack, tracks_from_boxes
from lidarpainter_models.scenes.undistortion import pinhole_of, undistort

JPEG_QUALITY = 80


@dataclass
class RealFrame:
    """One frame of a file, with the world at the vehicle."""

    segment: WaymoRecordSegment
    frame: WaymoFrame
    images: dict[str, WaymoImage]

    @classmethod
    def read(cls, path):
        segment = WaymoRecordSegment(path)
        frame = segment.read_frame(0)
        images, _ = segment.read_sensors(0)
        return cls(segment, frame, {image.camera_name: image for image in images})

    def tracks(self) -> tuple[ActorTrack, ...]:
        """One box per label, at the time of the FRONT image: there are no points to ask."""
        points = FramePoints(exposure_s(self.images["FRONT"]), np.zeros(3))
        points.add(np.zeros((1, 3)), np.zeros(1), is_top=True)
        records = box_records(
            self.frame,
            points,
            self.images,
            self.segment.cameras,
            torch.eye(4, dtype=torch.float64),
            {label.actor_id for label in self.frame.labels if label.speed_mps > 0.5},
        )
        columns = {
            name: [getattr(record, name) for record in records]
            for name in ("actor_id", "category", "timestamp_ns", "is_moving", "num_points")
        }
        sizes = map(list, zip(*[record.size_m for record in records], strict=True))
        columns |= dict(zip(("length_m", "width_m", "height_m"), sizes, strict=True))
        columns["frame_index"] = [0] * len(records)
        return tracks_from_boxes(columns, torch.stack([box.world_from_box for box in records]))

    def record(self, camera_name):
        """The image's record, in the vehicle frame of the frame's pose."""
        return image_record(
            self.images[camera_name],
            self.segment.cameras[camera_name],
            invert_rigid(self.frame.global_from_vehicle),
        )

    def overlay(self, camera_name) -> np.ndarray:
        """The image, undistorted, with the boxes over it."""
        record = self.record(camera_name)
        jpeg = np.frombuffer(self.images[camera_name].jpeg, np.uint8)
        bgr = cv2.imdecode(jpeg, cv2.IMREAD_COLOR)
        assert bgr is not None
        rgb = cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB)
        pinhole = pinhole_of(record.camera, record.distortion)
        image = np.ascontiguousarray(undistort(rgb, record.camera, record.distortion, pinhole))
        draw_boxes(image, pinhole, self.tracks(), record.timestamp_ns)
        return image


def write_overlay(frame_path, image_path, *, width_px=1280):
    """Draw the FRONT image of a frame into a JPEG file."""
    image = RealFrame.read(frame_path).overlay("FRONT")
    height_px = round(image.shape[0] * width_px / image.shape[1])
    small = cv2.resize(image, (width_px, height_px), interpolation=cv2.INTER_AREA)
    quality = [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY]
    jpeg = cv2.imencode(".jpg", cv2.cvtColor(small, cv2.COLOR_RGB2BGR), quality)[1]
    image_path.write_bytes(jpeg.tobytes())


def fields(content):
    """The fields of a protobuf message: a list of (number, value); messages stay bytes."""
    return [(number, value) for number, _, value in split(content)]


def all_of(content, number):
    """The values of a repeated field."""
    return [value for found, value in fields(content) if found == number]


if __name__ == "__main__":
    write_overlay(Path(sys.argv[1]), Path(sys.argv[2]))
