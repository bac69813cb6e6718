"""Boxes of the Waymo Open Dataset: where each actor was, and when.

A label is an upright box in the vehicle frame of its frame's pose. Of the two boxes it may hold:

- `camera_synced_box` is used where it is present: the box moved along its track to the moment at
  which the camera that sees most of it read the column with its centre. That moment is its time.
- `box` is used elsewhere (behind the car, beside the cameras, and in releases before 1.4). It was
  drawn around what the LiDARs saw, so its time is when they saw it: the median time of the TOP
  LiDAR's points inside, or of that direction where there are too few.

So one track may hold boxes of both kinds, each true at its own time, and the library interpolates
between them. A track moves by the same rule as PandaSet's: it travels at least 1 m, or it is
stated to move and does so at 1 m/s on average.
"""

import numpy as np
from jaxtyping import Float
from torch import Tensor

from lidarpainter_models.readers.source_logs.swept_boxes import (
    FORWARD,
    MOVING_MPS,
    SPINNING,
    SourceBox,
    SweepTimes,
    moving_actors,
)
from lidarpainter_models.readers.waymo.calibration import CameraCalibration
from lidarpainter_models.readers.waymo.cameras import ImageClock
from lidarpainter_models.readers.waymo.log import UprightBox, WaymoFrame, WaymoImage, WaymoLabel
from lidarpainter_models.scenes.records import BoxRecord

_US_PER_S = 1_000_000


class FramePoints:
    """The points of all LiDARs of a frame, in the vehicle frame at the frame's pose."""

    def __init__(self, time_s: float, top_position_m: np.ndarray) -> None:
        self.time_s = time_s
        """Of the frame's pose; where a LiDAR's columns have no time, that of its points."""
        self._top_position_m = top_position_m
        self._parts: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []

    def add(self, xyz_m: np.ndarray, offset_s: np.ndarray, *, is_top: bool) -> None:
        """Take the points of one LiDAR, each with its time after `time_s`."""
        sensor = np.full(len(xyz_m), SPINNING if is_top else FORWARD)
        self._parts.append((xyz_m, offset_s, sensor))

    def times(self) -> SweepTimes:
        """When the LiDARs saw a place, in seconds after `time_s`."""
        xyz_m, offset_s, sensor = map(np.concatenate, zip(*self._parts, strict=True))
        return SweepTimes(xyz_m, offset_s, sensor, self._top_position_m)


def moving_ids(frames: list[WaymoFrame]) -> set[str]:
    """Ids of the actors that move at any time."""
    boxes = {
        index: [_global_box(label, frame.global_from_vehicle) for label in frame.labels]
        for index, frame in enumerate(frames)
    }
    times_s = {index: frame.start_us / _US_PER_S for index, frame in enumerate(frames)}
    return moving_actors(boxes, times_s)


def box_records(
    frame: WaymoFrame,
    points: FramePoints,
    images: dict[str, WaymoImage],
    cameras: dict[str, CameraCalibration],
    world_from_vehicle: Float[Tensor, "4 4"],
    moving: set[str],
) -> list[BoxRecord]:
    """The boxes of a frame in the world, each at its own time and with its points counted."""
    if not frame.labels:
        return []
    times = points.times()
    clocks = {
        name: ImageClock(image, cameras[name]) for name, image in images.items() if name in cameras
    }
    records = []
    for label in frame.labels:
        found = _synced(label, frame, clocks)
        box = _source_box(label, label.box if found is None else found[0])
        rows = times.inside(box)
        time_s = points.time_s + times.time_of(box, rows) if found is None else found[1]
        is_moving = label.actor_id in moving
        records.append(box.record(world_from_vehicle, time_s, len(rows), is_moving=is_moving))
    return records


def _synced(
    label: WaymoLabel, frame: WaymoFrame, clocks: dict[str, ImageClock]
) -> tuple[UprightBox, float] | None:
    """The camera-synced box and its time; None where the frame does not have both."""
    camera_name, box = label.synced or ("", label.box)
    if camera_name not in clocks:
        return None
    pose = frame.global_from_vehicle.numpy()
    time_s = clocks[camera_name].time_of(pose[:3, :3] @ box.centre_m + pose[:3, 3])
    return None if time_s is None else (box, time_s)


def _source_box(label: WaymoLabel, box: UprightBox) -> SourceBox:
    return SourceBox(
        actor_id=label.actor_id,
        category=label.category,
        sensor=SPINNING,
        centre_m=box.centre_m,
        yaw_rad=box.heading_rad,
        size_m=box.size_m,
        is_stationary=label.speed_mps < MOVING_MPS,
    )


def _global_box(label: WaymoLabel, global_from_vehicle: Float[Tensor, "4 4"]) -> SourceBox:
    """The label with its centre in the global frame; its heading stays, nobody asks for it."""
    pose = global_from_vehicle.numpy()
    box = label.box
    centre_m = pose[:3, :3] @ box.centre_m + pose[:3, 3]
    return _source_box(label, UprightBox(centre_m, box.size_m, box.heading_rad))
