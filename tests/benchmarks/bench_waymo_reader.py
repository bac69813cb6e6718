"""Time and memory of the Waymo readers on frames of real size.

    PYTHONPATH=.:tests/support python tests/benchmarks/bench_waymo_reader.py [--frames 20]
        [--release v1]

A frame has five 1920 x 1280 images, two echoes of five LiDARs (64 x 2650 pixels with poses for
TOP, 116 x 150 for the others; eight of ten pixels hold an echo) and 75 labels, 40 of them
camera-synced. Frames differ in their times alone. Both releases are written to a temporary folder,
read once to warm up (imports, compilation, page cache), then read again and timed.
"""

import argparse
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import cv2
import google_crc32c
import numpy as np
import pyarrow.parquet as pq
import waymo_records
from rich.console import Console
from waymo_components import component_tables_of
from waymo_numbers import FrameNumbers
from waymo_records import frame_message, tfrecord

from lidarpainter_models.readers import ingest_scene
from lidarpainter_models.scenes.driving_scene import DrivingScene
from tasks.measuring import measured

WIDTH_PX, HEIGHT_PX = 1920, 1280
TOP_SHAPE, NEAR_SHAPE = (64, 2650), (116, 150)
START_US = 1_553_735_853_462_203
EXPOSURES_S = {
    "FRONT": 0.050,
    "FRONT_LEFT": 0.038,
    "FRONT_RIGHT": 0.063,
    "SIDE_LEFT": 0.026,
    "SIDE_RIGHT": 0.075,
}
YAWS_DEG = dict(zip(EXPOSURES_S, (0.0, 45.0, -45.0, 90.0, -90.0), strict=True))


def turned(yaw_deg, position_m=(0.0, 0.0, 0.0)):
    """A pose turned about z, as 16 numbers."""
    pose = np.eye(4)
    yaw = np.radians(yaw_deg)
    pose[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
    pose[:3, 3] = position_m
    return pose.reshape(16).tolist()


def random_jpeg(rng):
    """A JPEG of the size (about 400 kB) that the dataset's images have."""
    coarse = rng.integers(0, 255, (160, 240, 3), dtype=np.uint8)
    smooth = cv2.resize(coarse, (WIDTH_PX, HEIGHT_PX), interpolation=cv2.INTER_CUBIC)
    grain = rng.normal(0, 6, smooth.shape)
    pixels = np.clip(smooth + grain, 0, 255).astype(np.uint8)
    return cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, 75])[1].tobytes()


def range_images(shape, rng):
    """Two echoes with ranges that repeat in their upper bits, as a street's do."""
    images = np.full((2, *shape, 4), -1.0, dtype=np.float32)
    missed = rng.random(shape) < 0.2
    for image in images:
        steps = rng.normal(0, 0.05, shape).cumsum(axis=1)
        image[..., 0] = np.round(np.abs(20 + steps) * 256) / 256 + 1
        image[..., 1] = np.round(rng.exponential(0.2, shape), 3)
        image[missed] = -1.0
    return images


def frame(rng):
    """One frame at the start of the segment."""
    here = turned(43.8, (-25211.26, 42391.08, -160.6))
    poses = np.zeros((*TOP_SHAPE, 6), dtype=np.float32)
    poses[:] = 0.001, -0.002, np.radians(43.8), -25211.26, 42391.08, -160.6
    images = [
        {
            "name": name,
            "jpeg": random_jpeg(rng),
            "pose": here,
            "velocity": [0.0] * 6,
            "pose_time": START_US / 1e6 + offset_s,
            "shutter": 0.0026,
            "trigger": START_US / 1e6 + offset_s - 0.0233,
            "done": START_US / 1e6 + offset_s + 0.0233,
        }
        for name, offset_s in EXPOSURES_S.items()
    ]
    lasers = [{"name": "TOP", "returns": range_images(TOP_SHAPE, rng), "poses": poses}]
    lasers += [
        {"name": name, "returns": range_images(NEAR_SHAPE, rng), "poses": None}
        for name in ("FRONT", "SIDE_LEFT", "SIDE_RIGHT", "REAR")
    ]
    labels = []
    for number in range(75):
        x_m, y_m = rng.uniform(-50, 50, 2)
        box = [float(x_m), float(y_m), 1.0, 4.5, 2.0, 1.6, float(rng.uniform(-3, 3))]
        synced = ("FRONT", box) if number < 40 else None
        labels.append(
            {"id": f"a{number:021d}", "type": 1, "box": box, "speed": [0.0, 0.0], "synced": synced}
        )
    return FrameNumbers(START_US, here, images, lasers, labels)


def later(first, index):
    """The same frame some turns later."""
    shift_s = 0.1 * index
    times = ("pose_time", "trigger", "done")
    images = [
        {**image, **{name: image[name] + shift_s for name in times}} for image in first.images
    ]
    return replace(first, start_us=first.start_us + 100_000 * index, images=images)


def calibrations():
    """Cameras and LiDARs as numbers."""
    lens = [2050.0, 2050.0, 955.0, 640.0, 0.04, -0.33, 0.001, -0.0015, 0.0]
    cameras = [
        {
            "name": name,
            "intrinsic": lens,
            "extrinsic": turned(yaw_deg, (1.5, 0.0, 2.1)),
            "width": WIDTH_PX,
            "height": HEIGHT_PX,
            "readout": 2,
        }
        for name, yaw_deg in YAWS_DEG.items()
    ]
    beams = np.sort(np.linspace(-0.31, 0.04, 64)).tolist()
    lidars = [
        {
            "name": "TOP",
            "beams": beams,
            "limits": (-0.31, 0.04),
            "extrinsic": turned(148, (1.43, 0, 2.18)),
        }
    ]
    for name, yaw_deg in (("FRONT", 0), ("SIDE_LEFT", 90), ("SIDE_RIGHT", -90), ("REAR", 180)):
        limits = (-np.pi / 2, np.pi / 6)
        mount = turned(yaw_deg, (2.0, 0.5, 0.8))
        lidars.append({"name": name, "beams": [], "limits": limits, "extrinsic": mount})
    return cameras, lidars


def write_releases(folder, num_frames):
    """Both releases, a record and a few rows at a time."""
    first = frame(np.random.default_rng(1))
    cameras, lidars = calibrations()
    context = waymo_records.context_of(cameras, lidars)
    lasers = b"".join(
        waymo_records.message(5, waymo_records.laser_message(laser)) for laser in first.lasers
    )
    (folder / "v1").mkdir()
    with (folder / "v1/segment-bench_with_camera_labels.tfrecord").open("wb") as file:
        for index in range(num_frames):
            light = frame_message(replace(later(first, index), lasers=[]), context)
            file.write(tfrecord([light + lasers]))
    writers = {}
    for index in range(num_frames):
        tables = component_tables_of([later(first, index)], cameras, lidars, "bench")
        for name, table in tables.items():
            if index > 0 and name.endswith("_calibration"):
                continue
            if name not in writers:
                path = folder / "v2" / name / "bench.parquet"
                path.parent.mkdir(parents=True)
                writers[name] = pq.ParquetWriter(path, table.schema)
            writers[name].write_table(table)
    for writer in writers.values():
        writer.close()
    return len(light) + len(lasers)


def timed(release, folder, num_frames):
    """Read all frames; wall and processor seconds per frame, and the peak of memory."""
    with measured() as cost:
        path = ingest_scene("waymo", folder / release, "bench", folder / f"store-{release}")
    points = DrivingScene.open(path).manifest["counts"]["points"] // num_frames
    Console().print(
        f"{release}: {cost.seconds / num_frames:.3f} s a frame "
        f"({cost.cpu_seconds / num_frames:.3f} s of processor), {points} points a frame, "
        f"peak {cost.peak_memory_bytes / 1e6:.0f} MB"
    )


def main():
    """Write, warm up, time."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frames", type=int, default=20)
    parser.add_argument("--release", choices=("v1", "v2"), help="one of both alone")
    options = parser.parse_args()
    num_frames = options.frames
    releases = [options.release] if options.release else ["v1", "v2"]
    content = bytes(64 << 20)
    start = time.process_time()
    google_crc32c.value(content)
    rate = len(content) / (time.process_time() - start) / 1e6
    Console().print(f"CRC-32C: {rate:.0f} MB/s ({google_crc32c.implementation})")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        num_bytes = write_releases(folder, num_frames)
        Console().print(f"{num_frames} frames, {num_bytes / 1e6:.1f} MB a frame in version 1")
        for release in releases:
            ingest_scene("waymo", folder / release, "bench", folder / "warm", frames=slice(0, 1))
        for release in releases:
            timed(release, folder, num_frames)


if __name__ == "__main__":
    main()
