"""Rows of nuScenes' tables, each value checked when it is taken; errors name file and token."""

import reprlib
from dataclasses import dataclass
from pathlib import PurePosixPath
from typing import Any, TypeGuard

import numpy as np
from jaxtyping import Float
from torch import Tensor

from lidarpainter_models.errors import DataError
from lidarpainter_models.readers.source_logs.drive_poses import stated_pose

NS_PER_US = 1_000
MAX_NUMBER = 1e7
"""Larger metres, pixels and counts are refused."""
MAX_TIMESTAMP_US = (1 << 63) // NS_PER_US // 2
"""Larger times would not fit into 64 bits of nanoseconds."""
_SHORT_REPR = reprlib.Repr()
_SHORT_REPR.maxstring = _SHORT_REPR.maxlong = 60


@dataclass(frozen=True, slots=True)
class TableRow:
    """One row and where it stands."""

    values: dict[str, Any]
    where: str
    """File and token, to begin an error with."""

    def text(self, key: str) -> str:
        """A text that is not empty."""
        value = self.values.get(key)
        if not isinstance(value, str) or not value:
            raise self.refusal(key, "a text")
        return value

    def flag(self, key: str) -> bool:
        """True or false."""
        value = self.values.get(key)
        if not isinstance(value, bool):
            raise self.refusal(key, "true or false")
        return value

    def count(self, key: str) -> int:
        """A whole number from 0."""
        value = self.values.get(key)
        if not _is_whole(value) or not 0 <= value <= MAX_NUMBER:
            raise self.refusal(key, "a count")
        return value

    def timestamp_ns(self) -> int:
        """The row's time; the tables count microseconds."""
        value = self.values.get("timestamp")
        if not _is_whole(value) or not 0 < value < MAX_TIMESTAMP_US:
            raise self.refusal("timestamp", "whole microseconds")
        return value * NS_PER_US

    def numbers(self, key: str, count: int) -> list[float]:
        """A list of so many finite numbers."""
        value = self.values.get(key)
        if not isinstance(value, list) or len(value) != count or not all(map(_is_number, value)):
            raise self.refusal(key, f"{count} finite numbers")
        return [float(number) for number in value]

    def pose(self) -> Float[Tensor, "4 4"]:
        """The transform of `translation` (metres) and `rotation` (w, x, y, z), float64."""
        pose = stated_pose(self.numbers("rotation", 4), self.numbers("translation", 3))
        if pose is None:
            raise self.refusal("rotation", "a unit quaternion")
        return pose

    def intrinsics(self) -> dict[str, float]:
        """fx_px, fy_px, cx_px and cy_px of `camera_intrinsic`, a 3x3 pinhole matrix."""
        rows = self.values.get("camera_intrinsic")
        is_matrix = isinstance(rows, list) and [
            len(row) if isinstance(row, list) else 0 for row in rows
        ] == [3, 3, 3]
        flat = [number for row in rows for number in row] if is_matrix else []  # type: ignore[union-attr]
        if not flat or not all(map(_is_number, flat)):
            raise self.refusal("camera_intrinsic", "3 x 3 finite numbers")
        fx, skew, cx, zero, fy, cy, *last_row = flat
        is_pinhole = min(fx, fy) > 0 and skew == zero == 0 and np.array_equal(last_row, [0, 0, 1])
        if not is_pinhole:
            raise self.refusal("camera_intrinsic", "positive focal lengths and no skew")
        names = ("fx_px", "fy_px", "cx_px", "cy_px")
        return dict(zip(names, map(float, (fx, fy, cx, cy)), strict=True))

    def file(self) -> str:
        """`filename`, a path that stays below the root of the dataset."""
        name = self.text("filename")
        path = PurePosixPath(name)
        is_below = not path.is_absolute() and ".." not in path.parts and path.parts
        if not is_below or not name.isprintable() or "\\" in name:
            raise self.refusal("filename", "a path below the root of the dataset")
        return name

    def refusal(self, key: str, expected: str) -> DataError:
        """The error that a value of this row is not what was expected."""
        found = shown(self.values[key]) if key in self.values else "missing"
        return DataError(f"{self.where}: {key} is {found}, expected {expected}")


def shown(value: object) -> str:
    """A value from a file as an error shows it: on one short line, however large or deep it is."""
    return _SHORT_REPR.repr(value)


def _is_whole(value: object) -> TypeGuard[int]:
    return isinstance(value, int) and not isinstance(value, bool)


def _is_number(value: object) -> bool:
    """Finite and of a size that a map or an image can have; whole numbers may be endless."""
    if not isinstance(value, int | float) or isinstance(value, bool):
        return False
    return -MAX_NUMBER <= value <= MAX_NUMBER
