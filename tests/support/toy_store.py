"""The toy street in a store, and parameters so small that it is reconstructed in seconds."""

from pathlib import Path

import cv2
import torch
from toy_street import ToyStreet, world_from_car

from flows.overrides import with_overrides
from flows.parameters import ReconstructParameters
from flows.presets import preview
from lidarpainter_models.scenes.records import BoxRecord, ImageRecord
from lidarpainter_models.scenes.writer import SceneHeader, SceneWriter

TOY_SCENE = "toy/street"
SMALL = (
    "observation.width_px=120",
    "painter=warp",
    "novel.every_nth=2",
    "fit.steps=12",
    "fit.log_every=5",
    "fit.initialisation.num_gaussians=800",
    "fit.densification.budget=1000",
    "refine.steps=6",
    "refine.densification.budget=1000",
)
IDENTITY = torch.eye(4, dtype=torch.float64)


def write_toy_scene(store_root: Path, num_frames: int = 4) -> Path:
    """Store the toy street; the car that records it stands still."""
    street = ToyStreet(num_frames=num_frames)
    header = SceneHeader(licence="made from numbers", global_from_world=IDENTITY)
    with SceneWriter(store_root, "toy", "street", header) as writer:
        for view, sweep in zip(street.views, street.sweeps, strict=True):
            frame, time_ns = view.frame_index, view.timestamp_ns
            writer.add_frame(frame, timestamp_ns=time_ns, world_from_ego=IDENTITY)
            bgr = cv2.cvtColor(street.read_image(view).numpy(), cv2.COLOR_RGB2BGR)
            record = ImageRecord(camera_name="front", timestamp_ns=time_ns, camera=view.camera)
            writer.add_image(record, cv2.imencode(".jpg", bgr)[1].tobytes())
            writer.add_sweep(
                "top",
                street.read_sweep(sweep),
                timestamp_ns=time_ns,
                world_from_lidar=sweep.world_from_lidar,
            )
            track = street.tracks[0]
            box = BoxRecord(
                actor_id=track.actor_id,
                category=track.category,
                timestamp_ns=time_ns,
                world_from_box=world_from_car(torch.tensor(time_ns * 1e-9)),
                size_m=tuple(track.size_m.tolist()),
                is_moving=True,
                num_points=100,
            )
            writer.add_box(box)
    return writer.path


def small_parameters(**changes: object) -> ReconstructParameters:
    """The preview preset, shrunk until it takes seconds."""
    settings = [*SMALL, *(f"{name}={value}" for name, value in changes.items())]
    return with_overrides(preview(TOY_SCENE), settings)
