"""KITTI raw (synced and rectified) as a canonical scene.

    python docs/examples/kitti_raw.py DATE_FOLDER DRIVE OUT

`DATE_FOLDER` holds calib_*.txt and `DRIVE` (2011_09_26_drive_0001_sync) with oxts, velodyne_points
and image_02. Images are PNG: they are stored as JPEG of quality 98. A sweep is compensated: each
point by the pose at its own time, which follows from its azimuth. Boxes come from the drive's
tracklet_labels.xml, each at the time at which the LiDAR looked at it. Without that file there are
none, and moving cars would become part of the street: choose a quiet drive. A frame whose turn of
the LiDAR is missing (drive 0009 lacks four) or empty has its image alone.

The ego frame is the LiDAR's, 1.7 m above the road.
"""

import sys
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import cv2
import numpy as np
import torch

from lidarpainter_models.geometry.boxes import count_points_in_boxes
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.geometry.transforms import interpolate_rigid, invert_rigid
from lidarpainter_models.scenes.records import BoxRecord, ImageRecord, SweepPoints
from lidarpainter_models.scenes.tracks import does_move
from lidarpainter_models.scenes.writer import SceneHeader, SceneWriter

EARTH_RADIUS_M = 6378137.0
LICENCE = "CC BY-NC-SA 3.0, KITTI (Geiger et al., 2013)"
NUM_SLICES = 36  # of a turn; within one the pose is taken as constant


def calibration(file: Path) -> dict[str, np.ndarray]:
    """Rows `NAME: numbers` of a calibration file."""
    rows = (line.split(":", 1) for line in file.read_text().splitlines() if ":" in line)
    return {
        name: np.array(text.split(), dtype=float) for name, text in rows if name != "calib_time"
    }


def rigid(numbers: dict[str, np.ndarray]) -> torch.Tensor:
    """R and T of a calibration file as a 4x4 transform."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = numbers["R"].reshape(3, 3), numbers["T"]
    return torch.from_numpy(matrix)


def nanoseconds(text: str) -> int:
    """2011-09-26 13:02:25.594360375 as nanoseconds since the epoch."""
    second, fraction = text.strip().split(".")
    moment = datetime.strptime(second, "%Y-%m-%d %H:%M:%S").replace(tzinfo=UTC)
    return int(moment.timestamp()) * 10**9 + int(fraction.ljust(9, "0")[:9])


def global_from_imu(line: str, scale: float) -> torch.Tensor:
    """Mercator position and the rotation of one OXTS packet (x forward, y left, z up)."""
    latitude, longitude, altitude, roll, pitch, yaw = map(float, line.split()[:6])
    matrix = np.eye(4)
    turns = ((roll, 0), (pitch, 1), (yaw, 2))
    for angle, axis in turns:
        vector = np.zeros(3)
        vector[axis] = angle
        matrix[:3, :3] = cv2.Rodrigues(vector)[0] @ matrix[:3, :3]
    north = np.log(np.tan(np.radians(90 + latitude) / 2))
    matrix[:3, 3] = scale * EARTH_RADIUS_M * np.array([np.radians(longitude), north, 0])
    matrix[2, 3] = altitude
    return torch.from_numpy(matrix)


@dataclass(frozen=True)
class Turn:
    """One turn of the LiDAR: it begins and ends behind the car, clockwise from above."""

    before: torch.Tensor
    after: torch.Tensor
    time_ns: int
    period_ns: int

    @staticmethod
    def share(x_m: np.ndarray, y_m: np.ndarray) -> np.ndarray:
        """How much of a turn is over when the LiDAR looks at a place beside it."""
        return (np.pi - np.arctan2(y_m, x_m)) / (2 * np.pi)

    def pose(self, share: float) -> torch.Tensor:
        """world_from_velodyne so far into the turn."""
        return interpolate_rigid(self.before, self.after, torch.tensor(share, dtype=torch.float64))

    def compensated(self, scan: np.ndarray) -> torch.Tensor:
        """The points of the turn in the world, float32."""
        slices = np.floor(self.share(scan[:, 0], scan[:, 1]) * NUM_SLICES).clip(0, NUM_SLICES - 1)
        xyz_m = np.empty((len(scan), 3))
        for index in range(NUM_SLICES):
            pose = self.pose((index + 0.5) / NUM_SLICES).numpy()
            rows = slices == index
            xyz_m[rows] = scan[rows, :3] @ pose[:3, :3].T + pose[:3, 3]
        return torch.from_numpy(xyz_m.astype(np.float32))

    def box(self, tracklet: ElementTree.Element, pose: ElementTree.Element) -> BoxRecord:
        """A tracklet's box in this turn; its place is on the ground, in the LiDAR's frame."""
        height_m, width_m, length_m = (float(tracklet.findtext(name, "")) for name in "hwl")
        x_m, y_m, z_m, yaw = (float(pose.findtext(n, "")) for n in ("tx", "ty", "tz", "rz"))
        velodyne_from_box = np.eye(4)
        velodyne_from_box[:3, :3] = cv2.Rodrigues(np.array([0.0, 0.0, yaw]))[0]
        velodyne_from_box[:3, 3] = x_m, y_m, z_m + height_m / 2
        share = float(self.share(np.array(x_m), np.array(y_m)))
        return BoxRecord(
            actor_id="",
            category=tracklet.findtext("objectType", ""),
            timestamp_ns=self.time_ns + round((share - 0.5) * self.period_ns),
            world_from_box=self.pose(share) @ torch.from_numpy(velodyne_from_box),
            size_m=(length_m, width_m, height_m),
            is_moving=False,
            num_points=0,
        )


def turns_of(poses: list[torch.Tensor], times_ns: list[int]) -> list[Turn]:
    """The turns of a drive; each lasts from half way to its neighbours."""
    period_ns = round(float(np.median(np.diff(times_ns)))) if len(times_ns) > 1 else 10**8
    half, last = torch.tensor(0.5, dtype=torch.float64), len(poses) - 1
    return [
        Turn(
            before=interpolate_rigid(poses[max(index - 1, 0)], pose, half),
            after=interpolate_rigid(pose, poses[min(index + 1, last)], half),
            time_ns=time_ns,
            period_ns=period_ns,
        )
        for index, (pose, time_ns) in enumerate(zip(poses, times_ns, strict=True))
    ]


def boxes_of(file: Path, turns: list[Turn]) -> dict[int, list[BoxRecord]]:
    """The boxes of tracklet_labels.xml by frame, their points not yet counted."""
    found: dict[int, list[BoxRecord]] = {}
    if not file.is_file():
        return found
    tracklets = ElementTree.parse(file).getroot().findall("tracklets/item")  # noqa: S314
    for number, tracklet in enumerate(tracklets):
        first = int(tracklet.findtext("first_frame", ""))
        poses = tracklet.findall("poses/item")  # of a shortened drive some are left over
        boxes = [turn.box(tracklet, pose) for turn, pose in zip(turns[first:], poses, strict=False)]
        if not boxes:
            continue
        is_moving = does_move(torch.stack([box.world_from_box[:3, 3] for box in boxes]))
        for index, box in enumerate(boxes, start=first):
            known = replace(box, actor_id=f"tracklet-{number}", is_moving=is_moving)
            found.setdefault(index, []).append(known)
    return found


def counted(boxes: list[BoxRecord], xyz_m: torch.Tensor) -> list[BoxRecord]:
    """The boxes of a frame with the number of points that each holds."""
    if not boxes:
        return []
    poses = torch.stack([box.world_from_box for box in boxes])
    counts = count_points_in_boxes(xyz_m, poses, torch.tensor([box.size_m for box in boxes]))
    return [
        replace(box, num_points=count) for box, count in zip(boxes, counts.tolist(), strict=True)
    ]


def write(date_folder: Path, drive: str, store: Path) -> Path:
    """Write the drive as <store>/scenes/kitti/<drive>."""
    folder = date_folder / drive
    cameras = calibration(date_folder / "calib_cam_to_cam.txt")
    projection = cameras["P_rect_02"].reshape(3, 4)
    rectified = np.eye(4)
    rectified[:3, :3] = cameras["R_rect_00"].reshape(3, 3)
    shift = np.eye(4)  # P_rect holds K [I | t]: camera 2 beside camera 0
    shift[:3, 3] = np.linalg.solve(projection[:, :3], projection[:, 3])
    velo_from_imu = rigid(calibration(date_folder / "calib_imu_to_velo.txt"))
    camera_from_velo = torch.from_numpy(shift @ rectified) @ rigid(
        calibration(date_folder / "calib_velo_to_cam.txt")
    )
    packets = [file.read_text() for file in sorted((folder / "oxts/data").glob("*.txt"))]
    scale = float(np.cos(np.radians(float(packets[0].split()[0]))))
    velodyne = [global_from_imu(line, scale) @ invert_rigid(velo_from_imu) for line in packets]
    world_from_global = invert_rigid(velodyne[0])
    poses = [world_from_global @ pose for pose in velodyne]
    times_ns = [nanoseconds(t) for t in (folder / "oxts/timestamps.txt").read_text().splitlines()]
    turns = turns_of(poses, times_ns)
    boxes = boxes_of(folder / "tracklet_labels.xml", turns)
    lens: dict[str, Any] = {
        "fx_px": float(projection[0, 0]),
        "fy_px": float(projection[1, 1]),
        "cx_px": float(projection[0, 2]) + 0.5,  # KITTI counts from the first pixel's centre
        "cy_px": float(projection[1, 2]) + 0.5,
    }
    header = SceneHeader(licence=LICENCE, global_from_world=velodyne[0])
    with SceneWriter(store, "kitti", drive, header) as writer:
        for index, (time_ns, pose) in enumerate(zip(times_ns, poses, strict=True)):
            writer.add_frame(index, timestamp_ns=time_ns, world_from_ego=pose)
            file = folder / f"image_02/data/{index:010d}.png"
            image = cv2.imread(str(file))
            if image is None:
                raise FileNotFoundError(f"{file}: expected an image")
            camera = Camera(
                world_from_camera=pose @ invert_rigid(camera_from_velo),
                **lens,
                width_px=image.shape[1],
                height_px=image.shape[0],
            )
            jpeg = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 98])[1].tobytes()
            record = ImageRecord(camera_name="image_02", timestamp_ns=time_ns, camera=camera)
            writer.add_image(record, jpeg)
            file = folder / f"velodyne_points/data/{index:010d}.bin"
            scan = np.fromfile(file, "<f4") if file.is_file() else np.empty(0, "<f4")
            if not len(scan):
                writer.add_boxes(boxes.get(index, []))
                continue
            scan = scan.reshape(-1, 4).astype(np.float64)
            points = SweepPoints.of(
                turns[index].compensated(scan),
                intensity=torch.from_numpy(scan[:, 3].astype(np.float32)),
            )
            writer.add_sweep("velodyne", points, timestamp_ns=time_ns, world_from_lidar=pose)
            writer.add_boxes(counted(boxes.get(index, []), points.xyz_m))
    return writer.path


if __name__ == "__main__":
    sys.stdout.write(f"{write(Path(sys.argv[1]), sys.argv[2], Path(sys.argv[3]))}\n")
