"""The text files of KITTI: calibration, times, poses of the car, boxes.

Descriptions: Geiger, Lenz, Stiller and Urtasun, "Vision meets robotics: the KITTI dataset" (IJRR
2013), and the development kits of the raw data and of the tracking benchmark.
"""

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from xml.etree import ElementTree

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from lidarpainter_models.errors import DataError
from lidarpainter_models.geometry.transforms import (
    invert_rigid,
    rigid_from_rotation,
    rotation_from_vector,
)
from lidarpainter_models.readers.source_logs.folder import SourceFolder
from lidarpainter_models.scenes.validation import require_name, require_pose, require_size, shown

EARTH_RADIUS_M = 6378137.0
MAX_TEXT_BYTES = 64 << 20
MAX_BOXES = 200_000
_TIME = re.compile(r"(\d{4}-\d\d-\d\d \d\d:\d\d:\d\d)\.(\d{1,9})")
_NUM_OXTS = 30
_NUM_LABEL = 17
_BOX_UP = torch.tensor([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]], dtype=torch.float64)
"""Camera axes (x right, y down, z forward) from the axes of a box that faces right."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class KittiBox:
    """One box, in the frame of the LiDAR when it looked at the box."""

    actor_id: str
    category: str
    size_m: tuple[float, float, float]
    """Length, width, height."""
    lidar_from_box: Float[Tensor, "4 4"]


def read_lines(source: SourceFolder, name: str) -> list[str]:
    """The lines of a text file.

    Raises:
        DataError: the file is missing, larger than any of KITTI's, or no text.
    """
    content = source.read_bytes(name)
    if len(content) > MAX_TEXT_BYTES:
        raise DataError(f"{source.root / name}: {len(content)} bytes, expected {MAX_TEXT_BYTES}")
    try:
        return content.decode("ascii").splitlines()
    except UnicodeDecodeError:
        raise DataError(f"{source.root / name}: no text in ASCII") from None


def read_calibration(source: SourceFolder, name: str) -> dict[str, np.ndarray]:
    """Rows `NAME: numbers` or `NAME numbers` of a calibration file; others are left out."""
    rows = {}
    for line in read_lines(source, name):
        key, _, text = line.strip().replace(":", " ", 1).partition(" ")
        try:
            rows[key] = np.array(text.split(), dtype=float)
        except ValueError:
            continue  # when it was made, and the like
    return rows


def matrix(
    rows: Mapping[str, np.ndarray], names: Sequence[str], shape: tuple[int, ...], where: str
) -> np.ndarray:
    """The row of one of these names as a matrix.

    Raises:
        DataError: none is there, or its numbers are not as many or not finite.
    """
    for name in names:
        if name in rows:
            numbers = rows[name]
            if numbers.size != np.prod(shape) or not np.isfinite(numbers).all():
                expected = f"expected {np.prod(shape)} finite ones"
                raise DataError(f"{where}, {name}: {numbers.size} numbers, {expected}")
            return numbers.reshape(shape)
    raise DataError(f"{where}: no row {' or '.join(names)}")


def stated_rigid(rotation: np.ndarray, translation_m: np.ndarray, where: str) -> Tensor:
    """A rigid transform of a calibration file, float64."""
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3], pose[:3, 3] = torch.from_numpy(rotation), torch.from_numpy(translation_m)
    return require_pose(pose, where)


def read_times(source: SourceFolder, name: str) -> list[int | None]:
    """Times since the epoch in nanoseconds, one a line; None where a line is empty.

    Raises:
        DataError: a line is neither empty nor a time.
    """
    times: list[int | None] = []
    for number, line in enumerate(read_lines(source, name)):
        found = _TIME.fullmatch(line.strip())
        if line.strip() and not found:
            raise DataError(
                f"{source.root / name}, line {number}: {shown(line, 40)!r}, expected a time as "
                "2011-09-26 13:02:25.594360375"
            )
        times.append(_nanoseconds(found, f"{source.root / name}, line {number}") if found else None)
    return times


def global_from_imu(lines: Sequence[str], where: str) -> Float[Tensor, "packets 4 4"]:
    """Poses of the IMU (x forward, y left, z up), float64, in Mercator's plane with altitudes.

    A packet begins with latitude and longitude (degrees), altitude (m), roll, pitch and yaw (rad).
    The plane is scaled as at the latitude of the first packet, as the development kit has it.

    Raises:
        DataError: a packet is no list of numbers, or is nowhere on Earth.
    """
    packets = np.empty((len(lines), 6))
    for number, line in enumerate(lines):
        try:
            packets[number] = np.array(line.split(maxsplit=6)[:6], dtype=float)
        except ValueError:
            raise DataError(f"{where}, packet {number}: expected {_NUM_OXTS} numbers") from None
    latitude, longitude = np.radians(packets[:, 0]), np.radians(packets[:, 1])
    is_sound = np.isfinite(packets).all(axis=1) & (np.abs(packets[:, 0]) < 85.0)
    is_sound &= (np.abs(packets[:, 1]) <= 180.0) & (np.abs(packets[:, 2]) < 1e4)
    if not is_sound.all():
        raise DataError(f"{where}, packet {int(np.flatnonzero(~is_sound)[0])}: nowhere on Earth")
    scale_m = EARTH_RADIUS_M * np.cos(latitude[0])
    north_m = scale_m * np.log(np.tan(np.pi / 4 + latitude / 2))
    places_m = np.stack([scale_m * longitude, north_m, packets[:, 2]], axis=1)
    turns = torch.zeros(3, len(lines), 3, dtype=torch.float64)
    for axis in range(3):
        turns[axis, :, axis] = torch.from_numpy(packets[:, 3 + axis])
    roll, pitch, yaw = rotation_from_vector(turns)
    return rigid_from_rotation(yaw @ pitch @ roll, torch.from_numpy(places_m))


def read_tracklets(source: SourceFolder, name: str) -> Iterator[tuple[int, KittiBox]]:
    """Frames and boxes of a raw drive's tracklet_labels.xml.

    Raises:
        DataError: it is no such file, a number is missing, or a box has no size.
    """
    where, text = str(source.root / name), "\n".join(read_lines(source, name))
    if "<!ENTITY" in text:
        raise DataError(f"{where}: declares entities, expected none")
    try:
        root = ElementTree.fromstring(text)  # noqa: S314 - bounded, and without entities
    except ElementTree.ParseError as error:
        raise DataError(f"{where}: no XML ({error})") from None
    for number, tracklet in enumerate(root.iterfind("tracklets/item")):
        place = f"{where}, tracklet {number}"
        height_m, width_m, length_m, first = _numbers(
            tracklet, ("h", "w", "l", "first_frame"), place
        )
        size_m = (length_m, width_m, height_m)
        require_size(size_m, place)
        for row, pose in enumerate(tracklet.iterfind("poses/item")):
            x_m, y_m, z_m, yaw_rad = _numbers(pose, ("tx", "ty", "tz", "rz"), place)
            turn = rotation_from_vector(torch.tensor([0.0, 0.0, yaw_rad], dtype=torch.float64))
            centre_m = torch.tensor([x_m, y_m, z_m + height_m / 2], dtype=torch.float64)
            yield (
                int(first) + row,
                KittiBox(
                    actor_id=f"tracklet-{number}",
                    category=tracklet.findtext("objectType", ""),
                    size_m=size_m,
                    lidar_from_box=rigid_from_rotation(turn, centre_m),
                ),
            )


def read_labels(
    source: SourceFolder, name: str, camera_from_lidar: Float[Tensor, "4 4"]
) -> Iterator[tuple[int, KittiBox]]:
    """Frames and boxes of the tracking benchmark, whose frame is the rectified first camera's.

    A line holds frame, track, type, truncation, occlusion, angle, four edges of a rectangle,
    height, width and length, the middle of the box's lower side, and its turn about the camera's y.

    Raises:
        DataError: a line has other words, or a box no size.
    """
    lidar_from_camera = invert_rigid(camera_from_lidar)
    for number, line in enumerate(read_lines(source, name)):
        where, words = f"{source.root / name}, line {number}", line.split()
        if len(words) > 2 and words[2] == "DontCare":
            continue
        try:
            frame, track = int(words[0]), int(words[1])
            numbers = [float(word) for word in words[3:_NUM_LABEL]][7:]
        except (ValueError, IndexError):
            numbers = []
        if len(numbers) != 7 or not np.isfinite(numbers).all():
            raise DataError(f"{where}: {shown(line, 60)!r}, expected {_NUM_LABEL} words of a label")
        height_m, width_m, length_m, x_m, y_m, z_m, turn_rad = numbers
        size_m = (length_m, width_m, height_m)
        require_size(size_m, where)
        turn = rotation_from_vector(torch.tensor([0.0, turn_rad, 0.0], dtype=torch.float64))
        centre_m = torch.tensor([x_m, y_m - height_m / 2, z_m], dtype=torch.float64)
        yield (
            frame,
            KittiBox(
                actor_id=require_name(f"track-{track}", f"{where}: actor"),
                category=words[2],
                size_m=size_m,
                lidar_from_box=lidar_from_camera @ rigid_from_rotation(turn @ _BOX_UP, centre_m),
            ),
        )


def _numbers(element: ElementTree.Element, names: Sequence[str], where: str) -> list[float]:
    try:
        numbers = [float(element.findtext(name, "")) for name in names]
    except ValueError:
        numbers = [float("nan")]
    if not np.isfinite(numbers).all() or np.abs(numbers).max() > MAX_BOXES:
        raise DataError(f"{where}: expected finite numbers {', '.join(names)}")
    return numbers


def _nanoseconds(found: re.Match[str], where: str) -> int:
    try:
        moment = datetime.strptime(found[1], "%Y-%m-%d %H:%M:%S").replace(tzinfo=UTC)
    except ValueError:
        raise DataError(f"{where}: {found[1]} is no date") from None
    return int(moment.timestamp()) * 10**9 + int(found[2].ljust(9, "0"))
