"""KITTI raw (synced and rectified) as a canonical scene.

    python docs/examples/kitti_raw.py DATE_FOLDER DRIVE OUT

`DATE_FOLDER` holds calib_*.txt and `DRIVE` (2011_09_26_drive_0001_sync) with oxts, velodyne_points
and image_02. Images are PNG: they are stored as JPEG of quality 98. A sweep is compensated: each
point by the pose at its own time, which follows from its azimuth. Boxes are not read: without them
moving cars would become part of the street, so mask them or choose a quiet drive.
"""

import sys
from datetime import UTC, datetime
from pathlib import Path

import cv2
import numpy as np
import torch

from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.geometry.transforms import interpolate_rigid, invert_rigid
from lidarpainter_models.scenes.records import ImageRecord, SweepPoints
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


def compensated(scan: np.ndarray, before: torch.Tensor, after: torch.Tensor) -> np.ndarray:
    """Points of a turn in the world; it begins and ends behind, clockwise from above."""
    share = (np.pi - np.arctan2(scan[:, 1], scan[:, 0])) / (2 * np.pi)
    xyz_m = np.empty((len(scan), 3))
    for index in range(NUM_SLICES):
        rows = np.floor(share * NUM_SLICES).clip(0, NUM_SLICES - 1) == index
        moment = torch.tensor((index + 0.5) / NUM_SLICES, dtype=torch.float64)
        pose = interpolate_rigid(before, after, moment).numpy()
        xyz_m[rows] = scan[rows, :3] @ pose[:3, :3].T + pose[:3, 3]
    return xyz_m


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
    lens = {
        "fx_px": projection[0, 0],
        "fy_px": projection[1, 1],
        "cx_px": projection[0, 2] + 0.5,  # KITTI counts from the first pixel's centre
        "cy_px": projection[1, 2] + 0.5,
    }
    header = SceneHeader(licence=LICENCE, global_from_world=velodyne[0])
    with SceneWriter(store, "kitti", drive, header) as writer:
        for index, (time_ns, pose) in enumerate(zip(times_ns, poses, strict=True)):
            writer.add_frame(index, timestamp_ns=time_ns, world_from_ego=pose)
            image = cv2.imread(str(folder / f"image_02/data/{index:010d}.png"))
            camera = Camera(
                world_from_camera=pose @ invert_rigid(camera_from_velo),
                **{name: float(value) for name, value in lens.items()},
                width_px=image.shape[1],
                height_px=image.shape[0],
            )
            jpeg = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 98])[1].tobytes()
            record = ImageRecord(camera_name="image_02", timestamp_ns=time_ns, camera=camera)
            writer.add_image(record, jpeg)
            scan = np.fromfile(folder / f"velodyne_points/data/{index:010d}.bin", "<f4")
            scan = scan.reshape(-1, 4).astype(np.float64)
            first, last = poses[max(index - 1, 0)], poses[min(index + 1, len(poses) - 1)]
            half = torch.tensor(0.5, dtype=torch.float64)
            xyz_m = compensated(
                scan, interpolate_rigid(first, pose, half), interpolate_rigid(pose, last, half)
            )
            writer.add_sweep(
                "velodyne",
                SweepPoints.of(
                    torch.from_numpy(xyz_m.astype(np.float32)),
                    intensity=torch.from_numpy(scan[:, 3].astype(np.float32)),
                ),
                timestamp_ns=time_ns,
                world_from_lidar=pose,
            )
    return writer.path


if __name__ == "__main__":
    sys.stdout.write(f"{write(Path(sys.argv[1]), sys.argv[2], Path(sys.argv[3]))}\n")
