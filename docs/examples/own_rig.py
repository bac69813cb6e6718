"""Write a scene from plain arrays: a car with a camera and a LiDAR drives past a parked car.

python docs/examples/own_rig.py OUT && lidarpainter ingest canonical OUT/scenes/my-rig
"""

import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import ArrayLike

from lidarpainter_models.geometry.boxes import count_points_in_boxes
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.scenes.records import BoxRecord, ImageRecord, SweepPoints
from lidarpainter_models.scenes.writer import SceneHeader, SceneWriter

STRAIGHT = np.eye(3)
CAMERA_AXES = [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]  # columns: right, down, forward in the world
CAR_M = (4.2, 1.8, 1.5)  # length, width, height
LENS: dict[str, Any] = {"fx_px": 300.0, "fy_px": 300.0, "cx_px": 160.0, "cy_px": 90.0}


def pose(x_m: float, y_m: float, z_m: float, axes: ArrayLike = STRAIGHT) -> torch.Tensor:
    """world_from_body, 4x4 float64: the columns of `axes` are the body's axes in the world."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = axes, (x_m, y_m, z_m)
    return torch.from_numpy(matrix)


def sweep(x_m: float) -> SweepPoints:
    """Road around the car and the side of the parked car, already in the world."""
    road = np.mgrid[-15:30:0.5, -9:9:0.5, 0:1].reshape(3, -1).T + np.array([round(x_m), 0, 0])
    side = np.mgrid[10:14:0.1, 3.05:3.1:1, 0.3:1.5:0.1].reshape(3, -1).T
    xyz_m = np.concatenate([road, side]).astype(np.float32)
    return SweepPoints.of(torch.from_numpy(xyz_m))  # intensity, time, ring, echo: if you have them


def write(store: Path) -> Path:
    """Write <store>/scenes/my-rig/drive-1; leaving the block normally publishes it whole."""
    header = SceneHeader(licence="CC0, example", global_from_world=pose(0, 0, 0))
    with SceneWriter(store, "my-rig", "drive-1", header) as writer:
        for index in range(10):
            time_ns, x_m = 1_700_000_000_000_000_000 + 100_000_000 * index, 0.8 * index
            writer.add_frame(index, timestamp_ns=time_ns, world_from_ego=pose(x_m, 0, 0))
            eye = pose(x_m + 1.5, 0, 1.6, CAMERA_AXES)
            camera = Camera(world_from_camera=eye, **LENS, width_px=320, height_px=180)
            image = np.full((180, 320, 3), 127, np.uint8)  # yours: the camera's JPEG file
            record = ImageRecord(camera_name="front", timestamp_ns=time_ns, camera=camera)
            writer.add_image(record, cv2.imencode(".jpg", image)[1].tobytes())
            points, lidar = sweep(x_m), pose(x_m + 1.0, 0, 1.9)
            writer.add_sweep("roof", points, timestamp_ns=time_ns, world_from_lidar=lidar)
            car = pose(12, 3.9, 0.8)
            held = count_points_in_boxes(points.xyz_m, car[None], torch.tensor([CAR_M]))
            box = BoxRecord(
                actor_id="car-1",
                category="Car",
                timestamp_ns=time_ns,
                world_from_box=car,
                size_m=CAR_M,
                is_moving=False,  # of several boxes: scenes.tracks.does_move(their centres)
                num_points=int(held[0]),
            )
            writer.add_box(box)
    return writer.path


if __name__ == "__main__":
    sys.stdout.write(f"{write(Path(sys.argv[1]))}\n")
