"""Boxes of actors as a LiDAR swept over them: when each holds, and which actors move.

A sweep takes 0.1 s, in which a car drives metres. A box holds when its LiDAR saw the actor: at the
median time of the points inside it, or of those in its direction.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from lidarpainter_models.geometry.boxes import count_points_in_boxes
from lidarpainter_models.readers.source_logs.drive_poses import (
    NS_PER_S,
    nanoseconds,
    turned_about_up,
)
from lidarpainter_models.scenes.records import BoxRecord
from lidarpainter_models.scenes.tracks import does_move

SPINNING, FORWARD = 0, 1
"""Which LiDAR a box was drawn for, and which measured a point; -1 is a box of no particular one."""
MOVING_MPS = 1.0
"""A track moves if it travels as far as `does_move` asks, or if a box is marked as moving and its
mean speed is at least this (short tracks). Neither a person who stands and gestures nor the jitter
of a parked car's boxes counts as motion."""
MIN_POINTS_FOR_TIME = 5
_AZIMUTH_WINDOW_RAD = np.radians(1.5)
_NUM_AZIMUTH_SLABS = 360
_AZIMUTH_SLABS = 2
"""The window, in slabs of a degree, and one more for what lies on an edge."""
_SLAB_M = 0.5


@dataclass(frozen=True, slots=True)
class SourceBox:
    """One box in the dataset's own frame."""

    actor_id: str
    category: str
    sensor: int
    centre_m: np.ndarray
    yaw_rad: float
    """Heading of the length axis."""
    size_m: tuple[float, float, float]
    """Length, width, height."""
    is_stationary: bool

    def record(
        self,
        world_from_source: Float[Tensor, "4 4"],
        time_s: float,
        num_points: int,
        *,
        is_moving: bool,
    ) -> BoxRecord:
        """The box in the world, when it holds (since the epoch)."""
        source_from_box = turned_about_up(self.yaw_rad, torch.from_numpy(self.centre_m))
        return BoxRecord(
            actor_id=self.actor_id,
            category=self.category,
            timestamp_ns=nanoseconds(time_s),
            world_from_box=world_from_source @ source_from_box,
            size_m=self.size_m,
            is_moving=is_moving,
            num_points=num_points,
        )


def moving_actors(frames: dict[int, list[SourceBox]], frame_time_s: dict[int, float]) -> set[str]:
    """Ids of the actors that move at any time of the log."""
    boxes_of: dict[str, list[tuple[float, SourceBox]]] = {}
    for frame_index, boxes in frames.items():
        for box in boxes:
            boxes_of.setdefault(box.actor_id, []).append((frame_time_s[frame_index], box))
    return {actor_id for actor_id, boxes in boxes_of.items() if _moves(boxes)}


class SweepTimes:
    """Answers when the LiDARs saw a place in one frame, and how many points a box holds."""

    def __init__(
        self,
        xyz_m: np.ndarray,
        time_s: np.ndarray,
        sensor: np.ndarray,
        lidar_position_m: np.ndarray,
    ) -> None:
        self._time_s, self._sensor = time_s, sensor
        self._lidar_position_m = lidar_position_m
        self._origin_x_m = float(np.median(xyz_m[:, 0]))
        self._by_x = _Slabs(self._slab_of_x(xyz_m[:, 0]))
        self._sorted_m = np.ascontiguousarray(xyz_m[self._by_x.rows].T)
        away = xyz_m[:, :2] - lidar_position_m[:2]
        self._azimuth_rad = np.arctan2(away[:, 1], away[:, 0])
        self._by_azimuth = _Slabs(_slab_of_azimuth(self._azimuth_rad))

    def inside(self, box: SourceBox) -> np.ndarray:
        """Rows of the points that lie in the box."""
        half_m = np.array(box.size_m) / 2
        reach_m = float(np.hypot(half_m[0], half_m[1]))
        ends_m = np.array([box.centre_m[0] - reach_m, box.centre_m[0] + reach_m])
        first, last = self._slab_of_x(ends_m).tolist()
        slabs = self._by_x.between(first, last)
        near = np.flatnonzero(np.abs(self._sorted_m[1, slabs] - box.centre_m[1]) <= reach_m)
        away = self._sorted_m[:, slabs][:, near] - box.centre_m[:, None]
        cosine, sine = np.cos(box.yaw_rad), np.sin(box.yaw_rad)
        along = cosine * away[0] + sine * away[1]
        across = -sine * away[0] + cosine * away[1]
        local = np.abs(np.stack([along, across, away[2]]))
        return self._by_x.rows[slabs][near[(local <= half_m[:, None]).all(axis=0)]]

    def time_of(self, box: SourceBox, rows: np.ndarray) -> float:
        """When the box holds: the median time of its LiDAR's points, or of its direction's."""
        sensor = FORWARD if box.sensor == FORWARD else SPINNING
        own_s = self._time_s[rows][self._sensor[rows] == sensor]
        if len(own_s) >= MIN_POINTS_FOR_TIME:
            return float(np.median(own_s))
        direction = box.centre_m - self._lidar_position_m
        azimuth_rad = np.arctan2(direction[1], direction[0])
        (slab,) = _slab_of_azimuth(np.array([azimuth_rad])).tolist()
        near = self._by_azimuth.around(slab, _AZIMUTH_SLABS, width=_NUM_AZIMUTH_SLABS)
        turn = self._azimuth_rad[near] - azimuth_rad
        turn = np.abs((turn + np.pi) % (2 * np.pi) - np.pi)
        near = near[(turn < _AZIMUTH_WINDOW_RAD) & (self._sensor[near] == sensor)]
        return float(np.median(self._time_s[near] if len(near) else self._time_s))

    def _slab_of_x(self, x_m: np.ndarray) -> np.ndarray:
        limits = np.iinfo(np.int16)
        slabs = np.floor((x_m - self._origin_x_m) / _SLAB_M)
        return np.clip(slabs, limits.min, limits.max).astype(np.int16)


class _Slabs:
    """Rows by the slab they lie in: sorting 16-bit numbers takes a tenth of sorting floats."""

    def __init__(self, slab_of_row: np.ndarray) -> None:
        self.rows = np.argsort(slab_of_row, kind="stable")
        """All rows, sorted by slab."""
        self._slabs = slab_of_row[self.rows]

    def between(self, first: int, last: int) -> slice:
        """Where in `rows` the slabs from the first to the last lie, both included."""
        # numbers of the array's own type: others would have all of it converted first
        start = np.searchsorted(self._slabs, np.int16(first), side="left")
        return slice(int(start), int(np.searchsorted(self._slabs, np.int16(last), side="right")))

    def around(self, slab: int, reach: int, *, width: int) -> np.ndarray:
        """Rows at most `reach` slabs away on a ring of `width` slabs."""
        turns = [self.between(slab - reach + t, slab + reach + t) for t in (-width, 0, width)]
        return np.concatenate([self.rows[turn] for turn in turns])


def _slab_of_azimuth(azimuth_rad: np.ndarray) -> np.ndarray:
    slabs = np.floor((azimuth_rad + np.pi) / (2 * np.pi) * _NUM_AZIMUTH_SLABS)
    return np.clip(slabs, 0, _NUM_AZIMUTH_SLABS - 1).astype(np.int16)


def _moves(boxes: list[tuple[float, SourceBox]]) -> bool:
    times_s = np.array([time_s for time_s, _ in boxes])
    centres_m = np.array([box.centre_m for _, box in boxes])
    if does_move(torch.from_numpy(centres_m)):
        return True
    travelled_m = float(np.linalg.norm(centres_m - centres_m[0], axis=1).max())
    duration_s = float(times_s.max() - times_s.min())
    is_marked = any(not box.is_stationary for _, box in boxes)
    return is_marked and duration_s > 0 and travelled_m / duration_s >= MOVING_MPS


def seen_records(
    boxes: Sequence[BoxRecord],
    xyz_world_m: Float[Tensor, "points 3"],
    offset_ns: np.ndarray,
    origin_ns: int,
    lidar_world_m: np.ndarray,
) -> list[BoxRecord]:
    """Boxes of a sweep, each with its points counted and the time at which a LiDAR saw it.

    Args:
        boxes: where each stands in the world; their times and counts are replaced.
        xyz_world_m: the points of the sweep.
        offset_ns: when each was measured, after `origin_ns`.
        origin_ns: a time near them.
        lidar_world_m: where the LiDAR is.
    """
    if not boxes or not len(xyz_world_m):
        return list(boxes)
    xyz_m = xyz_world_m.double().numpy()
    of_one = np.full(len(xyz_m), SPINNING)
    times = SweepTimes(xyz_m, offset_ns / NS_PER_S, of_one, lidar_world_m)
    seen = []
    for box in with_counts(boxes, xyz_world_m):
        upright = _upright(box)
        offset_s = times.time_of(upright, times.inside(upright))
        seen.append(replace(box, timestamp_ns=origin_ns + round(offset_s * NS_PER_S)))
    return seen


def with_counts(
    boxes: Sequence[BoxRecord], xyz_world_m: Float[Tensor, "points 3"]
) -> list[BoxRecord]:
    """Boxes in the world, each told how many of the points it holds."""
    if not boxes:
        return []
    poses = torch.stack([box.world_from_box for box in boxes])
    sizes_m = torch.tensor([box.size_m for box in boxes])
    counts = count_points_in_boxes(xyz_world_m, poses, sizes_m).tolist()
    return [replace(box, num_points=count) for box, count in zip(boxes, counts, strict=True)]


def with_motion(frames: Mapping[int, Sequence[BoxRecord]]) -> dict[int, list[BoxRecord]]:
    """The boxes of a log by frame, each told whether its actor moves at any time (`does_move`)."""
    places_m: dict[str, list[Tensor]] = {}
    for boxes in frames.values():
        for box in boxes:
            places_m.setdefault(box.actor_id, []).append(box.world_from_box[:3, 3])
    moving = {name for name, places in places_m.items() if does_move(torch.stack(places))}
    return {
        frame: [replace(box, is_moving=box.actor_id in moving) for box in boxes]
        for frame, boxes in frames.items()
    }


def _upright(box: BoxRecord) -> SourceBox:
    """The box without its lean, which is some degrees: enough to tell when it was seen."""
    pose = box.world_from_box
    return SourceBox(
        actor_id=box.actor_id,
        category=box.category,
        sensor=SPINNING,
        centre_m=pose[:3, 3].numpy(),
        yaw_rad=float(torch.atan2(pose[1, 0], pose[0, 0])),
        size_m=box.size_m,
        is_stationary=not box.is_moving,
    )
