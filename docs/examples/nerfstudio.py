"""A nerfstudio or COLMAP-made folder (transforms.json, a PLY of points) as a canonical scene.

    python docs/examples/nerfstudio.py FOLDER OUT

The world must be metric with z up, images JPEG, their frames in the order of the drive; they get
times of a tenth of a second. `transform_matrix` is world_from_camera with OpenGL's axes (x right, y
up, z back). The points, which belong to no moment, are dealt out to the frames, each once.
"""

import json
import sys
from pathlib import Path

import numpy as np
import open3d
import torch

from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.scenes.records import Distortion, ImageRecord, SweepPoints
from lidarpainter_models.scenes.writer import SceneHeader, SceneWriter

PERIOD_NS = 100_000_000
EGO_AXES_FROM_CAMERA = np.array([[0, -1, 0], [0, 0, -1], [1, 0, 0]])  # forward, left, up


def write(folder: Path, store: Path, licence: str) -> Path:
    """Write the folder as <store>/scenes/nerfstudio/<its name>."""
    transforms = json.loads((folder / "transforms.json").read_text())
    cloud = open3d.io.read_point_cloud(folder / transforms["ply_file_path"])
    cloud_m = np.asarray(cloud.points)
    poses = []
    for frame in transforms["frames"]:
        world_from_camera = np.array(frame["transform_matrix"], dtype=float)
        world_from_camera[:3, 1:3] *= -1  # OpenGL's y up, z back to y down, z forward
        poses.append(world_from_camera)
    origin_m = poses[0][:3, 3].copy()  # the scene's world begins at the first camera
    global_from_world = torch.eye(4, dtype=torch.float64)
    global_from_world[:3, 3] = torch.from_numpy(origin_m)
    terms = tuple(float(transforms.get(name, 0.0)) for name in ("k1", "k2", "p1", "p2"))
    distortion = Distortion("brown", terms) if any(terms) else Distortion()
    header = SceneHeader(licence=licence, global_from_world=global_from_world)
    with SceneWriter(store, "nerfstudio", folder.resolve().name, header) as writer:
        for index, (frame, pose) in enumerate(zip(transforms["frames"], poses, strict=True)):
            pose[:3, 3] -= origin_m
            placed = torch.from_numpy(pose)
            world_from_ego = placed.clone()
            world_from_ego[:3, :3] = torch.from_numpy(pose[:3, :3] @ EGO_AXES_FROM_CAMERA)
            time_ns = PERIOD_NS * index
            writer.add_frame(index, timestamp_ns=time_ns, world_from_ego=world_from_ego)
            camera = Camera(
                world_from_camera=placed,
                fx_px=float(transforms["fl_x"]),
                fy_px=float(transforms["fl_y"]),
                cx_px=float(transforms["cx"]),
                cy_px=float(transforms["cy"]),
                width_px=int(transforms["w"]),
                height_px=int(transforms["h"]),
            )
            record = ImageRecord(
                camera_name="camera", timestamp_ns=time_ns, camera=camera, distortion=distortion
            )
            writer.add_image(record, (folder / frame["file_path"]).read_bytes())
            dealt_m = (cloud_m - origin_m)[index :: len(poses)].astype(np.float32)
            writer.add_sweep(
                "points",
                SweepPoints.of(
                    torch.from_numpy(dealt_m),
                ),
                timestamp_ns=time_ns,
                world_from_lidar=world_from_ego,
            )
    return writer.path


if __name__ == "__main__":
    path = write(Path(sys.argv[1]), Path(sys.argv[2]), licence="your own")
    sys.stdout.write(f"{path}\n")
