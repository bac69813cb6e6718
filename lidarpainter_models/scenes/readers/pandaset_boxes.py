"""Boxes of PandaSet: one track per actor, each box at the time its LiDAR saw the actor.

What the dataset does and what is made of it here:

- `dimensions.y` is the length along the box's own y axis, `dimensions.x` the width, `yaw` turns
  about the vertical. The canonical box has x along the length, hence yaw + 90 degrees.
- Moving actors in the overlap of the two LiDARs have two boxes with ids of their own
  (`cuboids.sensor_id` 0 spinning, 1 forward), linked by `cuboids.sibling_id`: each is drawn around
  the points of its LiDAR, which saw the actor at another moment. One track is kept, under the id
  of the spinning LiDAR; the other LiDAR's boxes fill the frames where it has none.
- A box has no time. The points inside have: the median of its LiDAR's is when the box holds. A
  sweep takes 0.1 s, so a car at 10 m/s would otherwise be up to half a metre off. (Moved along the
  track by 20 ms either way, the boxes of sequence 002 lose 2 % and 8 % of the spinning LiDAR's
  points; the forward LiDAR's fit the same boxes when carried by their own times.)
- `stationary` is per box. A track moves if it travels at least `MOVING_M`, or if a box is marked
  as moving and its mean speed is at least `MOVING_MPS` (short tracks). Neither a person who stands
  and gestures nor the jitter of a parked car's boxes counts as motion.
"""

from collections import Counter
from dataclasses import dataclass

import numpy as np

from lidarpainter_models.scenes.readers.dataframe_pickle import Table

SPINNING, FORWARD = 0, 1
"""Values of `cuboids.sensor_id` and of a point's `d`; -1 is a box outside the overlap."""
MOVING_M = 1.0
MOVING_MPS = 1.0
BOX_NUMBERS = (
    *("yaw", "stationary", "position.x", "position.y", "position.z"),
    *("dimensions.x", "dimensions.y", "dimensions.z", "cuboids.sensor_id"),
)
BOX_TEXTS = ("uuid", "label", "cuboids.sibling_id")
MIN_POINTS_FOR_TIME = 5
_AZIMUTH_WINDOW_RAD = np.radians(1.5)


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


def merge_boxes(tables: dict[int, Table]) -> dict[int, list[SourceBox]]:
    """The boxes of each frame, one per actor, with the ids of their tracks."""
    track_of = _tracks_of_forward_boxes(tables)
    frames: dict[int, list[SourceBox]] = {}
    for frame_index, table in tables.items():
        chosen: dict[str, SourceBox] = {}
        # the spinning LiDAR's boxes come last, so that theirs stay
        for row in np.argsort(-table["cuboids.sensor_id"], kind="stable"):
            box = _source_box(table, int(row), track_of)
            chosen[box.actor_id] = box
        frames[frame_index] = list(chosen.values())
    return frames


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
        order = np.argsort(xyz_m[:, 0], kind="stable")
        self._xyz_m, self._time_s, self._sensor = xyz_m[order], time_s[order], sensor[order]
        self._lidar_position_m = lidar_position_m
        away = xyz_m[:, :2] - lidar_position_m[:2]
        self._azimuth_rad = np.arctan2(away[:, 1], away[:, 0])
        self._unsorted = time_s, sensor

    def inside(self, box: SourceBox) -> np.ndarray:
        """Rows (of the points sorted by x) that lie in the box."""
        half_m = np.array(box.size_m) / 2
        reach_m = float(np.hypot(half_m[0], half_m[1]))
        first, last = np.searchsorted(
            self._xyz_m[:, 0], [box.centre_m[0] - reach_m, box.centre_m[0] + reach_m]
        )
        away = self._xyz_m[first:last] - box.centre_m
        cosine, sine = np.cos(box.yaw_rad), np.sin(box.yaw_rad)
        along = cosine * away[:, 0] + sine * away[:, 1]
        across = -sine * away[:, 0] + cosine * away[:, 1]
        local = np.abs(np.stack([along, across, away[:, 2]], axis=1))
        return first + np.flatnonzero((local <= half_m).all(axis=1))

    def time_of(self, box: SourceBox, rows: np.ndarray) -> float:
        """When the box holds: the median time of its LiDAR's points, or of its direction's."""
        sensor = FORWARD if box.sensor == FORWARD else SPINNING
        own_s = self._time_s[rows][self._sensor[rows] == sensor]
        if len(own_s) >= MIN_POINTS_FOR_TIME:
            return float(np.median(own_s))
        time_s, sensors = self._unsorted
        direction = box.centre_m - self._lidar_position_m
        turn = self._azimuth_rad - np.arctan2(direction[1], direction[0])
        turn = np.abs((turn + np.pi) % (2 * np.pi) - np.pi)
        near_s = time_s[(turn < _AZIMUTH_WINDOW_RAD) & (sensors == sensor)]
        return float(np.median(near_s if len(near_s) else time_s))


def _tracks_of_forward_boxes(tables: dict[int, Table]) -> dict[str, str]:
    """For each id of the forward LiDAR the id of the spinning one that most often is its twin."""
    votes: dict[str, Counter[str]] = {}
    spinning: set[str] = set()
    for table in tables.values():
        ids, siblings = table["uuid"], table["cuboids.sibling_id"]
        sensors = table["cuboids.sensor_id"]
        spinning.update(ids[sensors == SPINNING])
        for own, sibling, sensor in zip(ids, siblings, sensors, strict=True):
            if sensor == FORWARD:
                votes.setdefault(own, Counter())[sibling] += 1
            elif sensor == SPINNING:
                votes.setdefault(sibling, Counter())[own] += 1
    return {
        forward: next(twin for twin, _ in counts.most_common() if twin in spinning)
        for forward, counts in votes.items()
        if any(twin in spinning for twin in counts) and forward not in spinning
    }


def _source_box(table: Table, row: int, track_of: dict[str, str]) -> SourceBox:
    own_id = str(table["uuid"][row])
    width_m, length_m, height_m = (float(table[f"dimensions.{axis}"][row]) for axis in "xyz")
    return SourceBox(
        actor_id=track_of.get(own_id, own_id),
        category=str(table["label"][row]),
        sensor=int(table["cuboids.sensor_id"][row]),
        centre_m=np.array([float(table[f"position.{axis}"][row]) for axis in "xyz"]),
        yaw_rad=float(table["yaw"][row]) + np.pi / 2,
        size_m=(length_m, width_m, height_m),
        is_stationary=bool(table["stationary"][row]),
    )


def _moves(boxes: list[tuple[float, SourceBox]]) -> bool:
    times_s = np.array([time_s for time_s, _ in boxes])
    centres_m = np.array([box.centre_m for _, box in boxes])
    travelled_m = float(np.linalg.norm(centres_m - centres_m[0], axis=1).max())
    if travelled_m >= MOVING_M:
        return True
    duration_s = float(times_s.max() - times_s.min())
    is_marked = any(not box.is_stationary for _, box in boxes)
    return is_marked and duration_s > 0 and travelled_m / duration_s >= MOVING_MPS
