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
- `stationary` is per box; `swept_boxes.moving_actors` says which tracks move.
"""

from collections import Counter

import numpy as np

from lidarpainter_models.errors import DataError
from lidarpainter_models.readers.pandaset.dataframe_pickle import Table, read_table
from lidarpainter_models.readers.source_logs.folder import SourceFolder
from lidarpainter_models.readers.source_logs.swept_boxes import FORWARD, SPINNING, SourceBox
from lidarpainter_models.scenes.schema import is_safe_name
from lidarpainter_models.scenes.validation import require_label, require_size, shown

BOX_NUMBERS = (
    *("yaw", "position.x", "position.y", "position.z", "stationary"),
    *("dimensions.x", "dimensions.y", "dimensions.z", "cuboids.sensor_id"),
)
BOX_TEXTS = ("uuid", "label", "cuboids.sibling_id")
MAX_PLACE = 1e8
"""Of a coordinate in metres (the Earth's radius is 6.4e6) or a heading."""
MAX_BOXES = 5000
"""Of one frame; PandaSet's have about a hundred."""


def read_boxes(source: SourceFolder, frame_index: int) -> Table:
    """The table of boxes of a frame.

    Raises:
        DataError: the table is damaged, or a box has no place, size, heading, id or category.
    """
    name = f"annotations/cuboids/{frame_index:02d}.pkl.gz"
    table = read_table(source, name, BOX_NUMBERS, texts=BOX_TEXTS, max_rows=MAX_BOXES)
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
