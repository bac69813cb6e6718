"""Where the files of a KITTI drive lie: raw, or of the tracking benchmark."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int64
from torch import Tensor

from lidarpainter_models.errors import DataError
from lidarpainter_models.geometry.transforms import invert_rigid
from lidarpainter_models.readers.kitti.texts import (
    KittiBox,
    global_from_imu,
    matrix,
    read_calibration,
    read_labels,
    read_lines,
    read_times,
    read_tracklets,
    stated_rigid,
)
from lidarpainter_models.readers.source_logs.folder import SourceFolder
from lidarpainter_models.readers.source_logs.log import chosen_cameras

CAMERA_NAMES = ("image_02", "image_03")
"""The colour cameras; the grey ones beside them are not read."""
PERIOD_NS = 100_000_000
"""Of the tracking benchmark, which says no times, and of a drive of one frame."""
_TRACKLETS = "tracklet_labels.xml"


@dataclass(frozen=True, kw_only=True, eq=False)
class KittiDrive:
    """Where the files of a drive lie, and what its texts say; frames by position."""

    place: str
    images: str
    """Path of an image, with places for the camera and the number."""
    sweeps: str
    camera_from_lidar: Float[Tensor, "4 4"]
    """Of the rectified first camera."""
    projections: dict[str, np.ndarray]
    """3x4, by camera."""
    oxts_ns: list[int]
    global_from_lidar: Float[Tensor, "frames 4 4"]
    sweeps_ns: Int64[np.ndarray, " frames"]
    images_ns: dict[str, Int64[np.ndarray, " frames"]]
    boxes: Iterable[tuple[int, KittiBox]]

    @property
    def period_ns(self) -> int:
        """Of a turn of the LiDAR."""
        steps_ns = np.diff(self.sweeps_ns)
        return round(float(np.median(steps_ns))) if len(steps_ns) else PERIOD_NS


def list_kitti_drives(root: Path) -> tuple[str, ...]:
    """Names of the raw drives at a root or one folder below it, and of tracking sequences."""
    raw = [path.parent for pattern in ("", "*/") for path in root.glob(f"{pattern}*_sync/oxts")]
    tracked = [path.stem for path in root.glob("training/calib/[0-9]*.txt")]
    return tuple(sorted({*(path.name for path in raw), *tracked}))


def open_drive(source: SourceFolder, sequence: str, cameras: tuple[str, ...] | None) -> KittiDrive:
    """Read the texts of a drive below a root.

    Raises:
        DataError: it is not there, or a text is missing, damaged or senseless.
    """
    if sequence.isdecimal():
        return _tracking_sequence(source, sequence, cameras)
    found = [path for pattern in ("", "*/") for path in source.root.glob(f"{pattern}{sequence}")]
    if not found or not found[0].is_dir():
        raise DataError(f"{source.root}: no folder {sequence}, at it or one below")
    return _raw_drive(source, str(found[0].relative_to(source.root)), cameras)


def _raw_drive(source: SourceFolder, drive: str, cameras: tuple[str, ...] | None) -> KittiDrive:
    date, place = str(Path(drive).parent), str(source.root / drive)
    rows = read_calibration(source, f"{date}/calib_cam_to_cam.txt")
    where = f"{source.root / date}/calib_cam_to_cam.txt"
    velo_from_imu = _stated(source, f"{date}/calib_imu_to_velo.txt")
    camera_from_lidar = _rectified(matrix(rows, ["R_rect_00"], (3, 3), where), where) @ _stated(
        source, f"{date}/calib_velo_to_cam.txt"
    )
    oxts_ns = [time_ns for time_ns in read_times(source, f"{drive}/oxts/timestamps.txt") if time_ns]
    if not oxts_ns:
        raise DataError(f"{place}/oxts/timestamps.txt: no time, expected one for every frame")
    packets = [
        "".join(read_lines(source, f"{drive}/oxts/data/{number:010d}.txt"))
        for number in range(len(oxts_ns))
    ]
    known = [name for name in CAMERA_NAMES if (source.root / drive / name).is_dir()]
    chosen = chosen_cameras(cameras, known, place)
    has_boxes = (source.root / drive / _TRACKLETS).is_file()
    return KittiDrive(
        place=place,
        images=f"{drive}/{{}}/data/{{:010d}}.png",
        sweeps=f"{drive}/velodyne_points/data/{{:010d}}.bin",
        camera_from_lidar=camera_from_lidar,
        projections=_projections(rows, {name: f"P_rect_{name[-2:]}" for name in chosen}, where),
        oxts_ns=oxts_ns,
        global_from_lidar=global_from_imu(packets, f"{place}/oxts") @ invert_rigid(velo_from_imu),
        sweeps_ns=_own_times(source, f"{drive}/velodyne_points", oxts_ns),
        images_ns={name: _own_times(source, f"{drive}/{name}", oxts_ns) for name in chosen},
        boxes=read_tracklets(source, f"{drive}/{_TRACKLETS}") if has_boxes else (),
    )


def _tracking_sequence(
    source: SourceFolder, sequence: str, cameras: tuple[str, ...] | None
) -> KittiDrive:
    rows = read_calibration(source, f"training/calib/{sequence}.txt")
    where = f"{source.root}/training/calib/{sequence}.txt"
    velo_from_imu = _three_by_four(rows, ["Tr_imu_velo", "Tr_imu_to_velo"], where)
    rectified = _rectified(matrix(rows, ["R_rect", "R0_rect"], (3, 3), where), where)
    camera_from_lidar = rectified @ _three_by_four(rows, ["Tr_velo_cam", "Tr_velo_to_cam"], where)
    oxts = f"training/oxts/{sequence}.txt"
    packets = [line for line in read_lines(source, oxts) if line.strip()]
    if not packets:
        raise DataError(f"{source.root / oxts}: no packet, expected one for every frame")
    times_ns = [PERIOD_NS * number for number in range(len(packets))]
    folders = source.root / "training"
    known = [name for name in CAMERA_NAMES if (folders / name / sequence).is_dir()]
    chosen = chosen_cameras(cameras, known, f"{folders}, sequence {sequence}")
    labels = f"training/label_02/{sequence}.txt"
    has_boxes = (source.root / labels).is_file()
    return KittiDrive(
        place=f"{source.root}/training, sequence {sequence}",
        images=f"training/{{}}/{sequence}/{{:06d}}.png",
        sweeps=f"training/velodyne/{sequence}/{{:06d}}.bin",
        camera_from_lidar=camera_from_lidar,
        projections=_projections(rows, {name: f"P{int(name[-2:])}" for name in chosen}, where),
        oxts_ns=times_ns,
        global_from_lidar=global_from_imu(packets, str(source.root / oxts))
        @ invert_rigid(velo_from_imu),
        sweeps_ns=np.array(times_ns),
        images_ns={name: np.array(times_ns) for name in chosen},
        boxes=read_labels(source, labels, camera_from_lidar) if has_boxes else (),
    )


def _stated(source: SourceFolder, name: str) -> Tensor:
    rows, where = read_calibration(source, name), str(source.root / name)
    return stated_rigid(matrix(rows, ["R"], (3, 3), where), matrix(rows, ["T"], (3,), where), where)


def _three_by_four(rows: dict[str, np.ndarray], names: Sequence[str], where: str) -> Tensor:
    found = matrix(rows, names, (3, 4), where)
    return stated_rigid(found[:, :3], found[:, 3], f"{where}, {names[0]}")


def _rectified(rotation: np.ndarray, where: str) -> Tensor:
    return stated_rigid(rotation, np.zeros(3), f"{where}, rectifying rotation")


def _projections(
    rows: dict[str, np.ndarray], names: dict[str, str], where: str
) -> dict[str, np.ndarray]:
    """The projection of each camera, by the name of its row."""
    found = {}
    for camera, name in names.items():
        projection = matrix(rows, [name], (3, 4), where)
        is_lens = min(projection[0, 0], projection[1, 1]) > 0 and projection[2, 2] == 1
        if not is_lens or np.tril(projection[:, :3], -1).any():
            raise DataError(f"{where}, {name}: no projection of a camera, expected K [I | t]")
        found[camera] = projection
    return found


def _own_times(
    source: SourceFolder, folder: str, frames_ns: list[int]
) -> Int64[np.ndarray, " frames"]:
    """When a sensor recorded each frame; where its file does not say, when the car's pose was."""
    name = f"{folder}/timestamps.txt"
    found = read_times(source, name) if (source.root / name).is_file() else []
    found = found[: len(frames_ns)]
    found += [None] * (len(frames_ns) - len(found))
    own = [own_ns or frame_ns for own_ns, frame_ns in zip(found, frames_ns, strict=True)]
    return np.array(own, dtype=np.int64)
