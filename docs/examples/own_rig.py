"""Write a scene from plain arrays: a car with one camera and one LiDAR drives past a parked car.

python docs/examples/own_rig.py OUT && lidarpainter ingest canonical OUT/scenes/my-rig
"""

import sys
from pathlib import Path

import cv2
import numpy as np
import torch

from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.scenes.records import BoxRecord, ImageRecord, SweepPoints
from lidarpainter_models.scenes.writer import SceneHeader, SceneWriter

SPEED_MPS, PERIOD_S, NUM_FRAMES, START_NS = 8.0, 0.1, 10, 1_700_000_000_000_000_000
CAMERA_AXES = np.array([[0, 0, 1], [-1, 0, 0], [0, -1, 0]])  # columns: right, down, forward
LENS = {"fx_px": 300.0, "fy_px": 300.0, "cx_px": 160.0, "cy_px": 90.0}


def pose(x_m: float, y_m: float, z_m: float, axes: np.ndarray | None = None) -> torch.Tensor:
    """world_from_body, 4x4 float64: the columns of `axes` are the body's axes in the world."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = (np.eye(3) if axes is None else axes), (x_m, y_m, z_m)
    return torch.from_numpy(matrix)


def sweep(x_m: float) -> SweepPoints:
    """Road around the car and the side of the parked car, already in the world."""
    ground = np.stack(np.meshgrid(np.arange(-15, 30, 0.5), np.arange(-9, 9, 0.5)), -1)
    road = np.pad(ground.reshape(-1, 2) + np.array([round(x_m), 0]), ((0, 0), (0, 1)))
    side = np.stack(np.meshgrid(np.arange(10, 14, 0.1), [3.05], np.arange(0.3, 1.5, 0.1)), -1)
    xyz_m = torch.from_numpy(np.concatenate([road, side.reshape(-1, 3)]).astype(np.float32))
    count = len(xyz_m)
    return SweepPoints(
        xyz_m=xyz_m,
        intensity=torch.zeros(count),
        time_offset_ns=torch.zeros(count, dtype=torch.int32),  # after the sweep's own time
        ring=torch.full((count,), -1, dtype=torch.int16),  # unknown
        return_index=torch.zeros(count, dtype=torch.int8),
        lidar=torch.zeros(count, dtype=torch.uint8),
    )


def write(store: Path) -> Path:
    """Write <store>/scenes/my-rig/drive-1; leaving the block normally publishes it whole."""
    header = SceneHeader(licence="CC0, example", global_from_world=pose(0, 0, 0))
    with SceneWriter(store, "my-rig", "drive-1", header) as writer:
        for index in range(NUM_FRAMES):
            time_ns, x_m = START_NS + round(index * PERIOD_S * 1e9), SPEED_MPS * PERIOD_S * index
            writer.add_frame(index, timestamp_ns=time_ns, world_from_ego=pose(x_m, 0, 0))
            eye = pose(x_m + 1.5, 0, 1.6, CAMERA_AXES)
            camera = Camera(world_from_camera=eye, **LENS, width_px=320, height_px=180)
            record = ImageRecord(camera_name="front", timestamp_ns=time_ns, camera=camera)
            picture = np.full((180, 320, 3), 127, np.uint8)  # yours: the camera's JPEG file
            writer.add_image(record, cv2.imencode(".jpg", picture)[1].tobytes())
            points = sweep(x_m)
            lidar = pose(x_m + 1.0, 0, 1.9)
            writer.add_sweep("roof", points, timestamp_ns=time_ns, world_from_lidar=lidar)
            box = BoxRecord(
                actor_id="car-1",
                category="Car",
                timestamp_ns=time_ns,
                world_from_box=pose(12, 3.9, 0.8),
                size_m=(4.2, 1.8, 1.5),
                is_moving=False,
                num_points=480,
            )
            writer.add_box(box)
    return writer.path


if __name__ == "__main__":
    sys.stdout.write(f"{write(Path(sys.argv[1]))}\n")
