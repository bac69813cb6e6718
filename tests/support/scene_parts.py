"""Images, points, boxes and frames that a `SceneWriter` takes, each as small as can be."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.scenes.records import BoxRecord, ImageRecord, SweepPoints
from lidarpainter_models.scenes.writer import SceneHeader

IDENTITY = torch.eye(4, dtype=torch.float64)
AHEAD = IDENTITY.clone()
AHEAD[0, 3] = 10.0  # metres: a box around the origin would be the recording car's own
HEADER = SceneHeader(licence="test", global_from_world=IDENTITY)


def some_jpeg(width_px=32, height_px=24, seed=0):
    rng = np.random.default_rng(seed)
    image = rng.integers(0, 255, (height_px, width_px, 3), dtype=np.uint8)
    return cv2.imencode(".jpg", image)[1].tobytes()


def some_points(num_points=50, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return SweepPoints(
        xyz_m=torch.randn(num_points, 3, generator=generator) * 10,
        intensity=torch.rand(num_points, generator=generator),
        time_offset_ns=torch.arange(num_points, dtype=torch.int32),
        ring=torch.full((num_points,), -1, dtype=torch.int16),
        return_index=torch.zeros(num_points, dtype=torch.int8),
        lidar=torch.zeros(num_points, dtype=torch.uint8),
    )


def some_record(**changes):
    lens: dict[str, Any] = {"fx_px": 30.0, "fy_px": 30.0, "cx_px": 16.0, "cy_px": 12.0}
    camera = Camera(world_from_camera=IDENTITY, width_px=32, height_px=24, **lens)
    return ImageRecord(**{"camera_name": "front", "timestamp_ns": 5, "camera": camera, **changes})


def some_box(**changes):
    box = {
        "actor_id": "car-1",
        "category": "Car",
        "timestamp_ns": 5,
        "world_from_box": AHEAD,
        "size_m": (4.0, 2.0, 1.5),
        "is_moving": True,
        "num_points": 3,
    }
    return BoxRecord(**{**box, **changes})


def add_frame(writer, frame_index=0, num_points=50):
    writer.add_frame(frame_index, timestamp_ns=100 * frame_index, world_from_ego=IDENTITY)
    writer.add_image(some_record(), some_jpeg())
    add_sweep(writer, some_points(num_points, seed=frame_index))


def add_sweep(writer, points, **changes):
    writer.add_sweep("roof", points, timestamp_ns=7, **{"world_from_lidar": IDENTITY, **changes})


def files_below(folder):
    return sorted(path for path in Path(folder).rglob("*") if path.is_file())
