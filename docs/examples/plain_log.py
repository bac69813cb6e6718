"""Turn a log of plain files into a scene: images, LiDAR points, poses and boxes from CSV.

python docs/examples/plain_log.py LOG OUT NAME && lidarpainter ingest canonical OUT/scenes/my-car

LOG holds rig.json (the lens and the licence), frames.csv (poses of the car), images.csv (poses of
the camera at exposure), boxes.csv, images/FRAME.jpg and sweeps/FRAME.npy. Poses are position and
unit quaternion in one fixed map: car and boxes x forward, y left, z up; the camera x right, y down,
z forward. LiDAR points are x, y, z and intensity in the map, each moved to where it was hit.
"""

import csv
import json
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from lidarpainter_models.geometry.boxes import count_points_in_boxes
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.scenes.records import BoxRecord, ImageRecord, SweepPoints
from lidarpainter_models.scenes.writer import SceneHeader, SceneWriter

POSITION, QUATERNION = ("x_m", "y_m", "z_m"), ("qx", "qy", "qz", "qw")


def rows_of(path: Path) -> Iterator[dict[str, str]]:
    """The rows of a CSV file, by the names in its first line."""
    with path.open(newline="", encoding="utf-8") as file:
        yield from csv.DictReader(file)


def pose_of(row: dict[str, str]) -> torch.Tensor:
    """map_from_body, 4x4 float64, of a row with a position and a quaternion."""
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_quat([float(row[name]) for name in QUATERNION]).as_matrix()
    matrix[:3, 3] = [float(row[name]) for name in POSITION]
    return torch.from_numpy(matrix)


def write(log: Path, store: Path, name: str) -> Path:
    """Write STORE/scenes/my-car/NAME, whole or not at all; gives its folder."""
    rig = json.loads((log / "rig.json").read_text("utf-8"))
    images = {row["frame"]: row for row in rows_of(log / "images.csv")}
    boxes: dict[str, list[dict[str, str]]] = {}
    for row in rows_of(log / "boxes.csv"):
        boxes.setdefault(row["frame"], []).append(row)
    frames = list(rows_of(log / "frames.csv"))
    # the world begins at the first pose, so that float32 is exact enough
    global_from_world = torch.eye(4, dtype=torch.float64)
    global_from_world[:3, 3] = pose_of(frames[0])[:3, 3]
    world_from_map = torch.linalg.inv(global_from_world)
    header = SceneHeader(licence=rig["licence"], global_from_world=global_from_world)
    with SceneWriter(store, "my-car", name, header) as writer:
        for row in frames:
            number, time_ns = row["frame"], int(row["time_ns"])
            world_from_car = world_from_map @ pose_of(row)
            writer.add_frame(int(number), timestamp_ns=time_ns, world_from_ego=world_from_car)
            image = images[number]
            camera = Camera(world_from_camera=world_from_map @ pose_of(image), **rig["lens"])
            record = ImageRecord(
                camera_name="front", timestamp_ns=int(image["time_ns"]), camera=camera
            )
            writer.add_image(record, (log / f"images/{number}.jpg").read_bytes())
            points = np.load(log / f"sweeps/{number}.npy").astype(np.float32)
            offset = world_from_map[:3, 3].float()
            xyz_m = torch.from_numpy(points[:, :3]) + offset
            sweep = SweepPoints.of(xyz_m, intensity=torch.from_numpy(points[:, 3].copy()))
            roof = world_from_car.clone()
            roof[2, 3] += rig["lidar_height_m"]
            writer.add_sweep("roof", sweep, timestamp_ns=time_ns, world_from_lidar=roof)
            writer.add_boxes(
                [_box(one, time_ns, world_from_map, xyz_m) for one in boxes.get(number, [])]
            )
    return writer.path


def _box(
    row: dict[str, str], time_ns: int, world_from_map: torch.Tensor, xyz_m: torch.Tensor
) -> BoxRecord:
    size_m = (float(row["length_m"]), float(row["width_m"]), float(row["height_m"]))
    world_from_box = world_from_map @ pose_of(row)
    held = count_points_in_boxes(xyz_m, world_from_box[None], torch.tensor([size_m]))
    return BoxRecord(
        actor_id=row["actor"],
        category=row["category"],
        timestamp_ns=time_ns,
        world_from_box=world_from_box,
        size_m=size_m,
        is_moving=row["is_moving"] == "yes",
        num_points=int(held[0]),
    )


if __name__ == "__main__":
    sys.stdout.write(f"{write(Path(sys.argv[1]), Path(sys.argv[2]), sys.argv[3])}\n")
