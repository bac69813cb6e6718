"""A small stored scene, so that commands have something to work on."""

from pathlib import Path

import cv2
import pytest
import torch
from toy_street import ToyStreet, world_from_car

from catalog.store import STORE_ENVIRONMENT, open_store
from lidarpainter_models.scenes.records import BoxRecord, ImageRecord
from lidarpainter_models.scenes.writer import SceneHeader, SceneWriter
from tasks.ingest import record_scene

TOY_SCENE = "toy/street"
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


@pytest.fixture
def toy_store(tmp_path, monkeypatch):
    """A store that holds the toy street, and is the one commands use."""
    store = open_store(tmp_path / "store")
    record_scene(store, write_toy_scene(store.root))
    monkeypatch.setenv(STORE_ENVIRONMENT, str(store.root))
    return store
