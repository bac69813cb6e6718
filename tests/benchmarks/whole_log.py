"""A long log of Waymo's shape, to see what a whole drive costs: time, memory, progress.

    PYTHONPATH=. python tests/benchmarks/whole_log.py STORE [--frames 200]
    LIDARPAINTER_STORE=STORE lidarpainter reconstruct synthetic/whole-log --preset preview \
        --painter none --rounds 0 --set fit.steps=60 --memory 8GB --json

Writes a synthetic street as a recorded log: 5 cameras of 1920 x 1280, 64 beams, 10 Hz. Images are
drawn at a quarter of their width and enlarged: what they cost to store, read and fit follows from
their pixels, not from what they show. Prints CPU seconds and peak memory.
"""

import argparse
import math
import sys
from pathlib import Path

import cv2
import numpy as np
import torch

from catalog.store import open_store
from lidarpainter_models.scenes.records import BoxRecord, ImageRecord
from lidarpainter_models.scenes.writer import SceneHeader, SceneWriter
from lidarpainter_models.synthetic import RigCamera, SyntheticStreet, SyntheticStreetConfig
from tasks.ingest.ingest import record_scene
from tasks.measuring import measured

SIZE_PX = (1920, 1280)
DRAWN = 4
YAWS_DEG = {"front": 0, "front_left": 45, "front_right": -45, "side_left": 90, "side_right": -90}
CAMERAS = tuple(
    RigCamera(name=name, focal_per_width=1.07, yaw_rad=math.radians(yaw))
    for name, yaw in YAWS_DEG.items()
)


def jpeg_of(street, camera, timestamp_ns):
    small = camera.resized(width_px=SIZE_PX[0] // DRAWN, height_px=SIZE_PX[1] // DRAWN)
    rgb = street.render(small, timestamp_ns).rgb.numpy()
    bgr = np.round(rgb[..., ::-1].clip(0, 1) * 255).astype(np.uint8)
    large = cv2.resize(bgr, SIZE_PX, interpolation=cv2.INTER_CUBIC)
    return cv2.imencode(".jpg", large, [cv2.IMWRITE_JPEG_QUALITY, 90])[1].tobytes()


def add_frame(writer, street, frame):
    timestamp_ns = street.timestamps_ns[frame]
    pose = street.world_from_ego(timestamp_ns)
    writer.add_frame(frame, timestamp_ns=timestamp_ns, world_from_ego=pose)
    for rig in CAMERAS:
        camera = street.camera(rig.name, timestamp_ns)
        record = ImageRecord(camera_name=rig.name, timestamp_ns=timestamp_ns, camera=camera)
        writer.add_image(record, jpeg_of(street, camera, timestamp_ns))
    sweep = street.sweep(frame)
    writer.add_sweep(
        "top",
        sweep.points,
        timestamp_ns=sweep.timestamp_ns,
        world_from_lidar=sweep.world_from_lidar,
    )
    hits = torch.bincount(sweep.actor_index.long() + 1, minlength=street.num_actors + 1)[1:]
    for actor, num_points in zip(street.actors(sweep.timestamp_ns), hits.tolist(), strict=True):
        writer.add_box(
            BoxRecord(
                actor_id=actor.actor_id,
                category=actor.category,
                timestamp_ns=sweep.timestamp_ns,
                world_from_box=actor.world_from_box,
                size_m=actor.size_m,
                is_moving=actor.is_moving,
                num_points=num_points,
            )
        )


def write_log(street, store):
    header = SceneHeader(
        licence="Apache-2.0, drawn by LidarPainter",
        global_from_world=torch.eye(4, dtype=torch.float64),
    )
    frames = street.config.num_frames
    with SceneWriter(store, "synthetic", "whole-log", header) as writer:
        for frame in range(frames):
            add_frame(writer, street, frame)
            sys.stderr.write(f"\r{frame + 1}/{frames} frames")
        sys.stderr.write("\n")
        return writer.path


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("store", type=Path)
    parser.add_argument("--frames", type=int, default=200)
    options = parser.parse_args()
    config = SyntheticStreetConfig(
        seed=16,
        num_frames=options.frames,
        width_px=SIZE_PX[0],
        height_px=SIZE_PX[1],
        samples_per_axis=1,
        cameras=CAMERAS,
    )
    store = open_store(options.store)
    store.make()
    with measured() as cost:
        row = record_scene(store, write_log(SyntheticStreet(config), store.root))
    sys.stdout.write(
        f"{row['scene_id']}: {row['num_views']} images, {row['num_points']} points, "
        f"{row['num_actors']} actors, {row['num_bytes'] / 1e9:.2f} GB; {cost.cpu_seconds:.0f} CPU "
        f"s, {cost.peak_memory_bytes / 1e9:.2f} GB at most\n"
    )


if __name__ == "__main__":
    main()
