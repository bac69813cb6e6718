"""A nerfstudio or COLMAP-made folder (transforms.json, a PLY of points) as a canonical scene.

    python docs/examples/nerfstudio.py FOLDER OUT

The world must be metric with z up, and images in the order of the drive. Lenses may stand at the
top or in each frame (OPENCV, PINHOLE or OPENCV_FISHEYE). Frames with `timestamp_ns`, which our own
export writes, keep their times and may come from several cameras, named by their folders; others
get times of a tenth of a second. `transform_matrix` is world_from_camera with OpenGL's axes (x
right, y up, z back). The points, which belong to no moment, are dealt out to the frames, each once.
"""

import json
import sys
from pathlib import Path

import cv2
import numpy as np
import open3d
import torch

from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.scenes.records import Distortion, ImageRecord, SweepPoints
from lidarpainter_models.scenes.writer import SceneHeader, SceneWriter

PERIOD_NS = 100_000_000
EGO_AXES_FROM_CAMERA = np.array([[0, -1, 0], [0, 0, -1], [1, 0, 0]])  # forward, left, up
TERMS = {
    "OPENCV": ("brown", ("k1", "k2", "p1", "p2", "k3")),
    "PINHOLE": ("brown", ("k1", "k2", "p1", "p2", "k3")),
    "OPENCV_FISHEYE": ("fisheye", ("k1", "k2", "k3", "k4")),
}


def write(folder: Path, store: Path, licence: str) -> Path:
    """Write the folder as <store>/scenes/nerfstudio/<its name>."""
    transforms = json.loads((folder / "transforms.json").read_text())
    cloud = open3d.io.read_point_cloud(folder / transforms["ply_file_path"])
    frames = _by_moment(transforms["frames"])
    origin_m = _pose(frames[0][0])[:3, 3].clone()  # the scene's world begins at the first camera
    dealt_m = torch.from_numpy(np.asarray(cloud.points)) - origin_m
    global_from_world = torch.eye(4, dtype=torch.float64)
    global_from_world[:3, 3] = origin_m
    header = SceneHeader(licence=licence, global_from_world=global_from_world)
    with SceneWriter(store, "nerfstudio", folder.resolve().name, header) as writer:
        for index, images in enumerate(frames):
            time_ns = images[0]["timestamp_ns"]
            world_from_ego = _pose(images[0])
            world_from_ego[:3, 3] -= origin_m
            world_from_ego[:3, :3] @= torch.from_numpy(EGO_AXES_FROM_CAMERA).double()
            writer.add_frame(index, timestamp_ns=time_ns, world_from_ego=world_from_ego)
            for image in images:
                lens = {**transforms, **image}
                pose = _pose(image)
                pose[:3, 3] -= origin_m
                record = ImageRecord(
                    camera_name=_camera_name(image),
                    timestamp_ns=image["timestamp_ns"],
                    camera=_camera(lens, pose),
                    distortion=_distortion(lens),
                )
                writer.add_image(record, _jpeg(folder / image["file_path"]))
            writer.add_sweep(
                "points",
                SweepPoints.of(dealt_m[index :: len(frames)].float()),
                timestamp_ns=time_ns,
                world_from_lidar=world_from_ego,
            )
    return writer.path


def _by_moment(images: list[dict]) -> list[list[dict]]:
    """The images in order of time, a frame for each turn of the cameras."""
    timed = [{"timestamp_ns": PERIOD_NS * index, **image} for index, image in enumerate(images)]
    frames: list[list[dict]] = []
    taken: set[str] = set()
    for image in sorted(timed, key=lambda one: one["timestamp_ns"]):
        name = _camera_name(image)
        if not frames or name in taken:
            frames.append([])
            taken = set()
        frames[-1].append(image)
        taken.add(name)
    return frames


def _camera_name(image: dict) -> str:
    """The folder of the image below `images`."""
    folder = Path(image["file_path"]).parent.name
    return "camera" if folder in ("", "images") else folder


def _pose(image: dict) -> torch.Tensor:
    world_from_camera = torch.tensor(image["transform_matrix"], dtype=torch.float64)
    world_from_camera[:3, 1:3] *= -1  # OpenGL's y up, z back to y down, z forward
    return world_from_camera


def _camera(lens: dict, world_from_camera: torch.Tensor) -> Camera:
    missing = [name for name in ("fl_x", "fl_y", "cx", "cy", "w", "h") if name not in lens]
    if missing:
        sys.exit(f"{lens['file_path']}: no {', '.join(missing)}, in the frame or at the top")
    return Camera(
        world_from_camera=world_from_camera,
        fx_px=float(lens["fl_x"]),
        fy_px=float(lens["fl_y"]),
        cx_px=float(lens["cx"]),
        cy_px=float(lens["cy"]),
        width_px=int(lens["w"]),
        height_px=int(lens["h"]),
    )


def _distortion(lens: dict) -> Distortion:
    kind = lens.get("camera_model", "OPENCV")
    if kind not in TERMS:
        sys.exit(f"{lens['file_path']}: camera_model {kind}, expected {', '.join(TERMS)}")
    model, names = TERMS[kind]
    terms = tuple(float(lens.get(name, 0.0)) for name in names)
    return Distortion(model, terms) if model == "fisheye" or any(terms) else Distortion()


def _jpeg(file: Path) -> bytes:
    """The file's own bytes where it is a JPEG, else its pixels as one."""
    content = file.read_bytes()
    if content.startswith(b"\xff\xd8"):
        return content
    pixels = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR)
    if pixels is None:
        sys.exit(f"{file}: no image that can be decoded")
    return cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, 95])[1].tobytes()


if __name__ == "__main__":
    path = write(Path(sys.argv[1]), Path(sys.argv[2]), licence="your own")
    sys.stdout.write(f"{path}\n")
