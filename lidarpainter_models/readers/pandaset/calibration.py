"""Poses, times and lenses of PandaSet, read from its JSON files and checked.

Poses are `global_from_x` (the dataset's own frame, z up), rotations unit quaternions. Times are
seconds in the files, nanoseconds here.
"""

import math
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from lidarpainter_models.errors import DataError
from lidarpainter_models.readers.source_logs.drive_poses import nanoseconds, stated_pose
from lidarpainter_models.readers.source_logs.folder import SourceFolder
from lidarpainter_models.scenes.validation import require_time

_LARGEST = 1e8
"""Of a coordinate in metres (the Earth's radius is 6.4e6) or a number of pixels."""
_LARGEST_INTEGER = 2**1000
_LARGEST_TIME_S = 1e10
"""After the epoch: three centuries; more cannot be told in nanoseconds."""
CAMERA_NAMES = (
    *("front_camera", "front_left_camera", "front_right_camera"),
    *("left_camera", "right_camera", "back_camera"),
)


@dataclass(frozen=True, kw_only=True, eq=False)
class PandasetCamera:
    """One camera of a log, without the size of its images, which only they know."""

    global_from_camera: Float[Tensor, "frames 4 4"]
    """At exposure."""
    timestamps_ns: list[int]
    intrinsics: dict[str, float]
    """fx_px, fy_px, cx_px, cy_px."""


def read_camera(source: SourceFolder, name: str, num_frames: int) -> PandasetCamera:
    """Poses, times and lens of one camera.

    Raises:
        DataError: a file is missing, or does not say one thing per frame.
    """
    folder = f"camera/{name}"
    if not (source.root / folder).is_dir():
        there = ",".join(
            known for known in CAMERA_NAMES if (source.root / "camera" / known).is_dir()
        )
        hint = f"; to read the others alone: --cameras {there}" if there else ""
        raise DataError(f"{source.root / folder}: the camera folder is missing{hint}")
    file = f"{folder}/intrinsics.json"
    values, where = source.read_json(file, dict), str(source.root / file)
    intrinsics = {f"{key}_px": _number(values, key, where) for key in ("fx", "fy", "cx", "cy")}
    if min(intrinsics["fx_px"], intrinsics["fy_px"]) <= 0:
        raise DataError(f"{where}: focal lengths must be positive")
    return PandasetCamera(
        global_from_camera=read_poses(source, folder, num_frames),
        timestamps_ns=read_timestamps(source, folder, num_frames),
        intrinsics=intrinsics,
    )


def read_timestamps(source: SourceFolder, folder: str, num_frames: int | None = None) -> list[int]:
    """The times of a sensor, one per frame."""
    file = f"{folder}/timestamps.json"
    where = str(source.root / file)
    values = source.read_json(file, list)
    if not values or not all(_is_number(v) and abs(v) < _LARGEST_TIME_S for v in values):
        raise DataError(f"{where}: expected a list of times in seconds")
    times_ns = [
        require_time(nanoseconds(value), f"{where}, frame {index}")
        for index, value in enumerate(values)
    ]
    return _one_per_frame(times_ns, num_frames, where)


def read_poses(source: SourceFolder, folder: str, num_frames: int) -> Float[Tensor, "frames 4 4"]:
    """The poses of a sensor, one per frame, float64."""
    file = f"{folder}/poses.json"
    where = str(source.root / file)
    entries = _one_per_frame(source.read_json(file, list), num_frames, where)
    return torch.stack(
        [_pose(entry, f"{where}, frame {index}") for index, entry in enumerate(entries)]
    )


def _pose(entry: Any, where: str) -> Float[Tensor, "4 4"]:  # noqa: ANN401
    position, heading = (
        (entry.get("position"), entry.get("heading")) if isinstance(entry, dict) else (None, None)
    )
    if not (isinstance(position, dict) and isinstance(heading, dict)):
        raise DataError(f"{where}: expected a position and a heading")
    translation_m = [_number(position, axis, where) for axis in "xyz"]
    pose = stated_pose([_number(heading, axis, where) for axis in "wxyz"], translation_m)
    if pose is None:
        raise DataError(f"{where}: the heading is no unit quaternion")
    return pose


def _one_per_frame(values: list, num_frames: int | None, where: str) -> list:
    if num_frames is not None and len(values) != num_frames:
        raise DataError(f"{where}: {len(values)} entries, expected {num_frames}, one per frame")
    return values


def _number(values: dict[str, Any], key: str, where: str) -> float:
    value = values.get(key)
    if not _is_number(value) or abs(value) > _LARGEST:  # type: ignore[arg-type]
        found = f"{value!r:.50}" if isinstance(value, int | float | str) else type(value).__name__
        raise DataError(f"{where}: {key} is {found}, expected a finite number")
    return float(value)  # type: ignore[arg-type]


def _is_number(value: object) -> bool:
    """Whether JSON holds a number that a float can be; its integers have no end."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return False
    return math.isfinite(value) if isinstance(value, float) else abs(value) < _LARGEST_INTEGER
