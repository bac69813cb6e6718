"""Boxes of nuScenes: annotated at key frames, twice a second, and in between by interpolation.

What the dataset does and what is made of it here:

- `size` is width, length, height; the canonical order is length, width, height. The box's own axes
  (x along the length, y left, z up) are the canonical ones; `rotation` is w, x, y, z.
- A box is drawn around the points of its key sweep, which took 50 ms: it is taken to hold when
  the LiDAR looked at its centre, as the centre's azimuth tells; at 10 m/s half a metre would be
  at stake. That moment is the box's time, and the one at which it is interpolated.
- Between two neighbouring key frames that both have an instance, it has a box in every sweep, at
  the moment this sweep looked at it: slerp and a straight line between the two. Before the first,
  after the last, and where a key frame between lacks the instance, it has none.
- An instance moves as `does_move` says. The dataset's attributes (`vehicle.moving`) hold for a
  moment only and are not read.
"""

from bisect import bisect_right
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from lidarpainter_models.errors import DataError
from lidarpainter_models.geometry.transforms import interpolate_rigid, invert_rigid
from lidarpainter_models.readers.nuscenes.dataset import NuscenesTables
from lidarpainter_models.readers.nuscenes.recordings import LIDAR_NAME, Recording
from lidarpainter_models.readers.nuscenes.rows import TableRow
from lidarpainter_models.readers.nuscenes.sweeps import turn_offset_ns
from lidarpainter_models.readers.source_logs.log import naming
from lidarpainter_models.scenes.tracks import does_move
from lidarpainter_models.scenes.validation import require_name, require_size

_ROUNDS = 4
"""Until a box between key frames and the time it was seen agree to 0.1 mm."""


@dataclass(frozen=True, kw_only=True, eq=False)
class AnnotatedBox:
    """One instance in one sweep."""

    actor_id: str
    """The instance's token."""
    category: str
    size_m: tuple[float, float, float]
    """Length, width, height."""
    timestamp_ns: int
    """When the LiDAR looked at it."""
    global_from_box: Float[Tensor, "4 4"]


class Annotations:
    """The boxes of a scene at any of its sweeps."""

    def __init__(self, tables: NuscenesTables, samples: list[str], sweeps: list[Recording]) -> None:
        """Read the boxes of all key frames.

        Raises:
            DataError: a row makes no sense or refers to nothing, or a key frame has no sweep.
        """
        key_sweeps = {sweep.sample_token: sweep for sweep in sweeps if sweep.is_key_frame}
        categories: dict[str, str] = {}
        self._boxes: list[dict[str, AnnotatedBox]] = []
        self._key_ns: list[int] = []
        for sample in samples:
            if sample not in key_sweeps:
                where = tables["sample"].path
                raise DataError(f"{where}, token {sample}: no key frame of {LIDAR_NAME}")
            sweep = key_sweeps[sample]
            self._key_ns.append(sweep.timestamp_ns)
            self._boxes.append(_read_boxes(tables, sample, sweep, categories))
        if sorted(set(self._key_ns)) != self._key_ns:
            raise DataError(
                f"{tables['sample_data'].path}: the key frames of {LIDAR_NAME} are in another "
                f"order than their samples, the first of which is {samples[0]}"
            )
        self.moving = _moving(self._boxes)

    def boxes_at(self, sweep: Recording) -> list[AnnotatedBox]:
        """All boxes at a sweep."""
        before = bisect_right(self._key_ns, sweep.timestamp_ns) - 1
        if before >= 0 and self._key_ns[before] == sweep.timestamp_ns:
            return list(self._boxes[before].values())
        if before < 0 or before + 1 == len(self._boxes):
            return []
        first, second = self._boxes[before], self._boxes[before + 1]
        elapsed_ns = sweep.timestamp_ns - self._key_ns[before]
        share = elapsed_ns / (self._key_ns[before + 1] - self._key_ns[before])
        pairs = [(box, second[name]) for name, box in first.items() if name in second]
        return _between(pairs, share, _Turn(sweep)) if pairs else []


class _Turn:
    """The turn of the LiDAR that ended with a sweep."""

    def __init__(self, sweep: Recording) -> None:
        self._end_ns = sweep.timestamp_ns
        self._lidar_from_global = invert_rigid(sweep.global_from_sensor).numpy()

    def seen_ns(self, place_global_m: np.ndarray) -> int:
        """When the LiDAR looked at a place."""
        rotation, translation_m = self._lidar_from_global[:2, :3], self._lidar_from_global[:2, 3]
        place_m = rotation @ place_global_m + translation_m
        return self._end_ns + int(turn_offset_ns(place_m[:1], place_m[1:])[0])


def _read_boxes(
    tables: NuscenesTables, sample: str, sweep: Recording, categories: dict[str, str]
) -> dict[str, AnnotatedBox]:
    """The boxes of one key frame by instance; `categories` remembers what instances are."""
    turn = _Turn(sweep)
    boxes: dict[str, AnnotatedBox] = {}
    for row in tables["sample_annotation"].rows_with(sample):
        instance = row.text("instance_token")
        if instance in boxes:
            raise DataError(f"{row.where}: the sample has another box of instance {instance}")
        if instance not in categories:
            categories[instance] = _read_category(tables, instance, row.where)
        boxes[instance] = _read_box(row, categories[instance], turn)
    return boxes


def _read_category(tables: NuscenesTables, instance: str, asked_by: str) -> str:
    row = tables["instance"].row(instance, asked_by)
    with naming(row.where):
        require_name(instance, "actor")
    return tables["category"].row(row.text("category_token"), row.where).text("name")


def _read_box(row: TableRow, category: str, turn: _Turn) -> AnnotatedBox:
    width_m, length_m, height_m = row.numbers("size", 3)
    size_m = (length_m, width_m, height_m)
    require_size(size_m, row.where)
    global_from_box = row.pose()
    return AnnotatedBox(
        actor_id=row.text("instance_token"),
        category=category,
        size_m=size_m,
        timestamp_ns=turn.seen_ns(global_from_box[:3, 3].numpy()),
        global_from_box=global_from_box,
    )


def _between(
    pairs: list[tuple[AnnotatedBox, AnnotatedBox]], share: float, turn: _Turn
) -> list[AnnotatedBox]:
    """The boxes of a sweep that is `share` of the way from one key frame to the next."""
    moments_ns, shares = zip(*[_moment(*pair, share, turn) for pair in pairs], strict=True)
    poses = interpolate_rigid(
        torch.stack([first.global_from_box for first, _ in pairs]),
        torch.stack([second.global_from_box for _, second in pairs]),
        torch.tensor(shares, dtype=torch.float64),
    )
    return [
        replace(first, timestamp_ns=moment_ns, global_from_box=pose)
        for (first, _), moment_ns, pose in zip(pairs, moments_ns, poses, strict=True)
    ]


def _moment(
    first: AnnotatedBox, second: AnnotatedBox, share: float, turn: _Turn
) -> tuple[int, float]:
    """When a turn looks at a box on its way from one place to another, and how far it is then.

    Where the box stands and when it is looked at depend on each other; each round makes the error
    smaller by the box's speed over that of the beam at the box, less than a tenth.
    """
    start_m = first.global_from_box[:3, 3].numpy()
    end_m = second.global_from_box[:3, 3].numpy()
    seen_ns, last_ns = first.timestamp_ns, second.timestamp_ns
    for _ in range(_ROUNDS):
        seen_ns = turn.seen_ns(start_m + share * (end_m - start_m))
        seen_ns = min(max(seen_ns, first.timestamp_ns), last_ns)
        if first.timestamp_ns < last_ns:
            share = (seen_ns - first.timestamp_ns) / (last_ns - first.timestamp_ns)
    return seen_ns, share


def _moving(frames: list[dict[str, AnnotatedBox]]) -> frozenset[str]:
    """The instances that move at any time of the scene."""
    centres_m: dict[str, list[Tensor]] = {}
    for boxes in frames:
        for actor_id, box in boxes.items():
            centres_m.setdefault(actor_id, []).append(box.global_from_box[:3, 3])
    return frozenset(name for name, places in centres_m.items() if does_move(torch.stack(places)))
