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

from lidarpainter_models.errors import DataError
from lidarpainter_models.scenes.readers.dataframe_pickle import Table
from lidarpainter_models.scenes.readers.source_folder import SourceFolder
from lidarpainter_models.scenes.schema import is_safe_name
from lidarpainter_models.scenes.validation import require_label, require_size, shown

SPINNING, FORWARD = 0, 1
"""Values of `cuboids.sensor_id` and of a point's `d`; -1 is a box outside the overlap."""
MOVING_M = 1.0
MOVING_MPS = 1.0
BOX_NUMBERS = (
    *("yaw", "position.x", "position.y", "position.z", "stationary"),
    *("dimensions.x", "dimensions.y", "dimensions.z", "cuboids.sensor_id"),
)
BOX_TEXTS = ("uuid", "label", "cuboids.sibling_id")
MAX_PLACE = 1e8
"""Of a coordinate in metres (the Earth's radius is 6.4e6) or a heading."""
MAX_BOXES = 5000
"""Of one frame; PandaSet's have about a hundred."""
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


def read_boxes(source: SourceFolder, frame_index: int) -> Table:
    """The table of boxes of a frame.

    Raises:
        DataError: the table is damaged, or a box has no place, size, heading, id or category.
    """
    name = boxes_file(frame_index)
    table = source.read_table(name, BOX_NUMBERS, texts=BOX_TEXTS, max_rows=MAX_BOXES)
    for row in range(len(table["yaw"])):
        kind, actor_id = table["label"][row], str(table["uuid"][row])
        where = f"{source.root / name}, row {row}"
        require_label(kind, where)
        if not is_safe_name(actor_id):
            raise DataError(f"{where}: the uuid is {shown(actor_id)!r}, expected a plain name")
        where = f"{source.root / name}, {kind} {actor_id}"
        require_size(_size_m(table, row), where)
        place = [float(table[column][row]) for column in BOX_NUMBERS[:4]]
        if not all(abs(number) < MAX_PLACE for number in place):
            raise DataError(f"{where}: the pose is not finite")
        if not isinstance(table["cuboids.sibling_id"][row], str):
            raise DataError(f"{where}: the sibling's id is no text")
    if not np.isin(table["cuboids.sensor_id"], (-1, SPINNING, FORWARD)).all():
        raise DataError(f"{source.root / name}: a sensor_id is none of -1, 0 and 1")
    return table


def boxes_file(frame_index: int) -> str:
    """Where the boxes of a frame lie."""
    return f"annotations/cuboids/{frame_index:02d}.pkl.gz"


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
    return SourceBox(
        actor_id=track_of.get(own_id, own_id),
        category=str(table["label"][row]),
        sensor=int(table["cuboids.sensor_id"][row]),
        centre_m=np.array([float(table[f"position.{axis}"][row]) for axis in "xyz"]),
        yaw_rad=float(table["yaw"][row]) + np.pi / 2,
        size_m=_size_m(table, row),
        is_stationary=bool(table["stationary"][row]),
    )


def _size_m(table: Table, row: int) -> tuple[float, float, float]:
    """Length, width, height."""
    width_m, length_m, height_m = (float(table[f"dimensions.{axis}"][row]) for axis in "xyz")
    return length_m, width_m, height_m


def _moves(boxes: list[tuple[float, SourceBox]]) -> bool:
    times_s = np.array([time_s for time_s, _ in boxes])
    centres_m = np.array([box.centre_m for _, box in boxes])
    travelled_m = float(np.linalg.norm(centres_m - centres_m[0], axis=1).max())
    if travelled_m >= MOVING_M:
        return True
    duration_s = float(times_s.max() - times_s.min())
    is_marked = any(not box.is_stationary for _, box in boxes)
    return is_marked and duration_s > 0 and travelled_m / duration_s >= MOVING_MPS
