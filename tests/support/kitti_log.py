"""Write a scene as KITTI published its data: a synchronised raw drive, or a tracking sequence.

Written from the papers and development kits, not from the reader. The scene has one LiDAR and
cameras that look the same way; its poses are in Mercator's plane afterwards.

    write_kitti_raw(scene, root)        # root/2011_09_26/2011_09_26_drive_0005_sync
    write_kitti_tracking(scene, root)   # root/training/.../0007
"""

from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from scipy.spatial.transform import Rotation

from lidarpainter_models.geometry.timed_poses import poses_at
from lidarpainter_models.geometry.transforms import invert_rigid, rigid_from_rotation
from lidarpainter_models.readers.source_logs.drive_poses import turned_about_up
from lidarpainter_models.scenes.image_bytes import decode_image

DATE, DRIVE, SEQUENCE = "2011_09_26", "2011_09_26_drive_0005_sync", "0007"
EARTH_RADIUS_M = 6378137.0
LATITUDE, LONGITUDE, ALTITUDE_M = np.radians(49.0), np.radians(8.4), 116.0
PERIOD_NS = 100_000_000
LIDAR_FROM_IMU = rigid_from_rotation(
    torch.from_numpy(Rotation.from_euler("xyz", (0.01, -0.004, 0.02)).as_matrix()),
    torch.tensor([-0.81, 0.32, -0.8], dtype=torch.float64),
)
_BOX_UP = torch.tensor([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]], dtype=torch.float64)


class _Drive:
    """What both layouts write."""

    def __init__(self, scene, camera_names):
        """`camera_names`: the scene's cameras by those of KITTI."""
        self.scene, self.camera_names = scene, camera_names
        self.times_ns = np.array([scene.sweeps_of(f)[0].timestamp_ns for f in scene.frame_indices])
        poses = [scene.sweeps_of(f)[0].world_from_lidar for f in scene.frame_indices]
        self.world_from_lidar = torch.stack(poses)
        self.scale_m = EARTH_RADIUS_M * np.cos(LATITUDE)
        north_m = self.scale_m * np.log(np.tan(np.pi / 4 + LATITUDE / 2))
        place = torch.tensor([self.scale_m * LONGITUDE, north_m, ALTITUDE_M], dtype=torch.float64)
        first = self.world_from_lidar[0] @ LIDAR_FROM_IMU
        turn = turned_about_up(0.4, torch.zeros(3, dtype=torch.float64))
        self.global_from_world = turn.clone()
        self.global_from_world[:3, 3] = place - turn[:3, :3] @ first[:3, 3]
        scene.manifest["global_from_world"] = self.global_from_world.reshape(16).tolist()
        views = {name: scene.views_of(own)[0] for name, own in camera_names.items()}
        self.cameras = {name: view.camera for name, view in views.items()}
        lidar_from_camera = {
            name: invert_rigid(self.world_at(np.array([view.timestamp_ns]))[0])
            @ view.camera.world_from_camera
            for name, view in views.items()
        }
        # the first camera stands a little to the left of camera 2
        beside = torch.eye(4, dtype=torch.float64)
        beside[0, 3] = -0.06
        self.camera_from_lidar = invert_rigid(lidar_from_camera["image_02"] @ beside)
        self.projections = {
            name: self._projection(self.cameras[name], pose)
            for name, pose in lidar_from_camera.items()
        }
        self._leave_out_the_seam()

    def world_at(self, times_ns):
        return poses_at(self.world_from_lidar, self.times_ns, times_ns)

    def _projection(self, camera, lidar_from_camera):
        lens = np.array(
            [
                [camera.fx_px, 0, camera.cx_px - 0.5],
                [0, camera.fy_px, camera.cy_px - 0.5],
                [0, 0, 1],
            ]
        )
        beside = invert_rigid(lidar_from_camera) @ invert_rigid(self.camera_from_lidar)
        return np.hstack([lens, lens @ beside[:3, 3:].numpy()])

    def packets(self):
        """OXTS packets, a line each."""
        lines = []
        for pose in self.global_from_world @ self.world_from_lidar @ LIDAR_FROM_IMU:
            x_m, y_m, z_m = pose[:3, 3].tolist()
            latitude = 2 * np.arctan(np.exp(y_m / self.scale_m)) - np.pi / 2
            angles = Rotation.from_matrix(pose[:3, :3].numpy()).as_euler("xyz")
            degrees = np.degrees((latitude, x_m / self.scale_m))
            lines.append(" ".join(map(repr, map(float, (*degrees, z_m, *angles, *[0.0] * 24)))))
        return lines

    def scan(self, position):
        """Points as measured: each in the frame of the LiDAR at the time its azimuth has.

        What the LiDAR passes as it begins or ends its turn behind the car is left out of the
        scene too: there may be no such time.
        """
        points = self.points[position]
        return np.hstack(
            [self._seen(points.xyz_m.double().numpy(), position)[0], points.intensity[:, None]]
        ).astype("<f4")

    def boxes(self, position):
        """Number and track of each box, and its pose when the LiDAR looked at it, in its frame."""
        there = list(self._boxes_in(self.scene.frame_indices[position]))
        if not there:
            return
        poses = torch.stack([pose for _number, _track, pose in there])
        _, times_ns, _ = self._seen(poses[:, :3, 3].numpy(), position)
        in_lidar = invert_rigid(self.world_at(times_ns)) @ poses
        for (number, track, _pose), pose in zip(there, in_lidar, strict=True):
            yield number, track, pose

    def _boxes_in(self, frame_index):
        """Number, track and world pose of each box of a frame."""
        for number, track in enumerate(self.scene.tracks):
            for row in (track.frame_indices == frame_index).nonzero()[:, 0].tolist():
                yield number, track, track.world_from_box[row]

    def _leave_out_the_seam(self):
        frames, self.points, passed = self.scene.frame_indices, [], set()
        for position, frame_index in enumerate(frames):
            points = self.scene.read_points(frame_index)
            found = torch.from_numpy(self._seen(points.xyz_m.double().numpy(), position)[2])
            kept = {name: getattr(points, name)[found] for name in points.__dataclass_fields__}
            self.points.append(type(points)(**kept))
            there = list(self._boxes_in(frame_index))
            if there:
                centres = torch.stack([pose[:3, 3] for _number, _track, pose in there]).numpy()
                is_seen = self._seen(centres, position)[2]
                passed |= {one[0] for one, seen in zip(there, is_seen, strict=True) if not seen}
        self.scene.read_points = lambda frame: self.points[frames.index(frame)]
        self.scene.tracks = tuple(
            track for number, track in enumerate(self.scene.tracks) if number not in passed
        )

    def _seen(self, xyz_world_m, position):
        """Places in the LiDAR's frame, when it looked at them, and whether it did in this turn."""
        times_ns = np.full(len(xyz_world_m), self.times_ns[position])
        moved_ns, seen_m = np.zeros_like(times_ns), np.empty((len(xyz_world_m), 3))
        rows = np.arange(len(xyz_world_m))  # those whose time has not settled
        for _ in range(12):
            lidar_from_world = invert_rigid(self.world_at(times_ns[rows])).numpy()
            seen_m[rows] = np.einsum("nij,nj->ni", lidar_from_world[:, :3, :3], xyz_world_m[rows])
            seen_m[rows] += lidar_from_world[:, :3, 3]
            share = 0.5 - np.arctan2(seen_m[rows, 1], seen_m[rows, 0]) / (2 * np.pi)
            offset_ns = np.rint((share - 0.5) * PERIOD_NS).astype(np.int64)
            moved_ns[rows] = times_ns[rows] - (self.times_ns[position] + offset_ns)
            times_ns[rows] = self.times_ns[position] + offset_ns
            rows = rows[moved_ns[rows] != 0]
            if not len(rows):
                break
        return seen_m, times_ns, np.abs(moved_ns) < 1000

    def write_files(self, position, image, sweep):
        """The images and the sweep of a frame at paths."""
        for name, own in self.camera_names.items():
            frame_index = self.scene.frame_indices[position]
            view = next(v for v in self.scene.views_of(own) if v.frame_index == frame_index)
            pixels: Any = decode_image(bytes(self.scene.read_jpeg(view)))
            _write(image(name), cv2.imencode(".png", pixels)[1].tobytes())
        _write(sweep, self.scan(position).tobytes())


def write_kitti_raw(scene, root, camera_names=None):
    """Write a synchronised raw drive; gives its folder."""
    drive = _Drive(scene, camera_names or {name: name for name in scene.camera_names})
    date = Path(root) / DATE
    folder = date / DRIVE
    _write_rows(
        date / "calib_cam_to_cam.txt",
        {"calib_time": "09-Jan-2012 13:57:47", "R_rect_00": np.eye(3)}
        | {f"P_rect_{name[-2:]}": rows for name, rows in drive.projections.items()},
    )
    _write_rigid(date / "calib_velo_to_cam.txt", drive.camera_from_lidar)
    _write_rigid(date / "calib_imu_to_velo.txt", LIDAR_FROM_IMU)
    times = "\n".join(map(_date, drive.times_ns.tolist())) + "\n"
    for sensor in ("oxts", "velodyne_points", *drive.camera_names):
        _write(folder / sensor / "timestamps.txt", times.encode())
    poses: dict[int, list[tuple[int, object, torch.Tensor]]] = {}
    for position, packet in enumerate(drive.packets()):
        _write(folder / f"oxts/data/{position:010d}.txt", packet.encode())
        drive.write_files(
            position,
            lambda name, n=position: folder / name / f"data/{n:010d}.png",
            folder / f"velodyne_points/data/{position:010d}.bin",
        )
        for number, track, pose in drive.boxes(position):
            poses.setdefault(number, []).append((position, track, pose))
    items = "".join(_tracklet(found) for found in poses.values())
    text = f"<boost_serialization><tracklets>{items}</tracklets></boost_serialization>"
    _write(folder / "tracklet_labels.xml", text.encode())
    return folder


def write_kitti_tracking(scene, root, camera_names=None):
    """Write a sequence of the tracking benchmark; gives its root."""
    drive = _Drive(scene, camera_names or {name: name for name in scene.camera_names})
    folder = Path(root) / "training"
    _write_rows(
        folder / f"calib/{SEQUENCE}.txt",
        {f"P{int(name[-2:])}": rows for name, rows in drive.projections.items()}
        | {"R_rect": np.eye(3), "Tr_velo_cam": drive.camera_from_lidar[:3].numpy()}
        | {"Tr_imu_velo": LIDAR_FROM_IMU[:3].numpy()},
        colon="",
    )
    _write(folder / f"oxts/{SEQUENCE}.txt", "\n".join(drive.packets()).encode())
    lines = ["0 -1 DontCare -1 -1 -10 1 2 3 4 -1000 -1000 -1000 -10 -1 -1 -1"]
    for position in range(len(drive.times_ns)):
        drive.write_files(
            position,
            lambda name, n=position: folder / name / SEQUENCE / f"{n:06d}.png",
            folder / f"velodyne/{SEQUENCE}/{position:06d}.bin",
        )
        lines += [_label(drive, position, *box) for box in drive.boxes(position)]
    _write(folder / f"label_02/{SEQUENCE}.txt", "\n".join(lines).encode())
    return Path(root)


def _label(drive, position, number, track, lidar_from_box):
    camera_from_box = drive.camera_from_lidar @ lidar_from_box
    length_m, width_m, height_m = track.size_m.tolist()
    turn = camera_from_box[:3, :3] @ _BOX_UP.T
    turn_rad = float(torch.atan2(turn[0, 2], turn[0, 0]))
    x_m, y_m, z_m = camera_from_box[:3, 3].tolist()
    numbers = (height_m, width_m, length_m, x_m, y_m + height_m / 2, z_m, turn_rad)
    return f"{position} {number} Car 0 0 0 0 0 9 9 " + " ".join(map(repr, numbers))


def _tracklet(found):
    """A track's boxes, which must be in frames that follow each other."""
    first, track, _ = found[0]
    length_m, width_m, height_m = track.size_m.tolist()
    poses = ""
    for _, _, pose in found:
        x_m, y_m, z_m = pose[:3, 3].tolist()
        yaw_rad = float(torch.atan2(pose[1, 0], pose[0, 0]))
        poses += f"<item><tx>{x_m!r}</tx><ty>{y_m!r}</ty><tz>{z_m - height_m / 2!r}</tz>"
        poses += f"<rx>0</rx><ry>0</ry><rz>{yaw_rad!r}</rz></item>"
    return (
        f"<item><objectType>Car</objectType><h>{height_m!r}</h><w>{width_m!r}</w>"
        f"<l>{length_m!r}</l><first_frame>{first}</first_frame><poses>{poses}</poses></item>"
    )


def _date(time_ns):
    moment = datetime.fromtimestamp(time_ns // 10**9, UTC)
    return f"{moment:%Y-%m-%d %H:%M:%S}.{time_ns % 10**9:09d}"


def _write_rigid(file, pose):
    _write_rows(file, {"R": pose[:3, :3].numpy(), "T": pose[:3, 3].numpy()})


def _write_rows(file, rows, colon=":"):
    lines = [
        f"{name}{colon} {row}"
        if isinstance(row, str)
        else f"{name}{colon} {' '.join(map(repr, row.ravel().tolist()))}"
        for name, row in rows.items()
    ]
    _write(file, "\n".join(lines).encode())


def _write(path, content):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content)
