"""One real key frame of nuScenes as a v1.0 folder, from an info pickle of mmdetection3d.

The pickle has matrices instead of the tables; its transforms from the LiDAR to each camera hold
the car's motion between their times, so that the ego pose of every image follows from them. The
pickle is read as inert data with an allow-list.

    python tests/support/nuscenes_key_frame.py FOLDER IMAGE.jpg  # docs/pictures/overlay_nuscenes
"""

import json
import shutil
import sys
import tempfile
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from nuscenes_log import token_of, written_pose

from lidarpainter_models.checks.overlay import draw_overlay
from lidarpainter_models.geometry.transforms import (
    invert_rigid,
    rigid_from_rotation,
    rotation_from_vector,
)
from lidarpainter_models.readers import ingest_scene
from lidarpainter_models.readers.pandaset.pickle_tree import Made, Named, read_pickle_tree
from lidarpainter_models.scenes.driving_scene import DrivingScene

SCENE_NAME = "scene-0061"
ALLOWED = (
    Named("numpy", "dtype"),
    Named("numpy.core.multiarray", "scalar"),
    Named("_codecs", "encode"),
)


def read_key_frame(folder):
    """The one entry of the pickle in a folder, and the names of its classes."""
    (file,) = Path(folder).glob("*.pkl")
    tree = read_pickle_tree(file.read_bytes(), ALLOWED)
    (info,) = tree["data_list"]
    return info, {number: name for name, number in tree["metainfo"]["categories"].items()}


def number_of(value):
    """A plain number, or one that numpy pickled."""
    if not isinstance(value, Made):
        return value
    dtype, encoded = value.arguments
    content = encoded.arguments[0].encode("latin-1")
    return np.frombuffer(content, dtype.arguments[0])[0].item()


def write_key_frame(folder, root):
    """Write the key frame of a folder below `root`; instances are named by their position."""
    info, class_names = read_key_frame(folder)
    tables = _Tables(Path(root))
    ego_from_lidar = _matrix(info["lidar_points"]["lidar2ego"])
    global_from_ego = _matrix(info["ego2global"])
    global_from_lidar = global_from_ego @ ego_from_lidar
    sweep = {"file": Path(folder) / info["lidar_points"]["lidar_path"]}
    tables.add_data("LIDAR_TOP", info["timestamp"], global_from_ego, ego_from_lidar, **sweep)
    for channel, image in info["images"].items():
        ego_from_camera = _matrix(image["cam2ego"])
        camera_from_lidar = _matrix(image["lidar2cam"])
        global_from_camera = global_from_lidar @ invert_rigid(camera_from_lidar)
        tables.add_data(
            *(channel, image["timestamp"], global_from_camera @ invert_rigid(ego_from_camera)),
            ego_from_camera,
            file=Path(folder) / image["img_path"],
            intrinsic=image["cam2img"],
        )
    for position, instance in enumerate(info["instances"]):
        name = class_names.get(instance["bbox_label_3d"], "of no class")
        tables.add_box(position, name, global_from_lidar, instance["bbox_3d"])
    tables.write(info["timestamp"])


class _Tables:
    def __init__(self, root):
        self.root = root
        names = "sample_data ego_pose calibrated_sensor sensor sample_annotation instance category"
        self.rows: dict[str, list[dict[str, Any]]] = {name: [] for name in names.split()}

    def add_data(self, channel, time_s, global_from_ego, ego_from_sensor, *, file, intrinsic=()):
        name = f"samples/{channel}/{file.name}"
        (self.root / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(file, self.root / name)
        token = token_of(channel)
        self.rows["sensor"].append({"token": token, "channel": channel})
        self.rows["calibrated_sensor"].append(
            {
                "token": token,
                "sensor_token": token,
                **written_pose(ego_from_sensor),
                "camera_intrinsic": intrinsic,
            }
        )
        self.rows["ego_pose"].append({"token": token, **written_pose(global_from_ego)})
        self.rows["sample_data"].append(
            {
                "token": token,
                "sample_token": token_of("sample"),
                "ego_pose_token": token,
                "calibrated_sensor_token": token,
                "timestamp": round(1e6 * time_s),
                "is_key_frame": True,
                "width": 1600 if intrinsic else 0,
                "height": 900 if intrinsic else 0,
                "filename": name,
            }
        )

    def add_box(self, position, name, global_from_lidar, box):
        x_m, y_m, z_m, length_m, width_m, height_m, yaw_rad = map(number_of, box)
        turned = rotation_from_vector(torch.tensor([0, 0, yaw_rad], dtype=torch.float64))
        centre_m = torch.tensor([x_m, y_m, z_m], dtype=torch.float64)
        category = {"token": token_of(name), "name": name}
        if category not in self.rows["category"]:
            self.rows["category"].append(category)
        instance = {"token": f"instance-{position}", "category_token": category["token"]}
        self.rows["instance"].append(instance)
        self.rows["sample_annotation"].append(
            {
                "token": token_of("annotation", position),
                "sample_token": token_of("sample"),
                "instance_token": instance["token"],
                **written_pose(global_from_lidar @ rigid_from_rotation(turned, centre_m)),
                "size": [width_m, length_m, height_m],
            }
        )

    def write(self, time_s):
        scene = {"token": token_of("scene"), "name": SCENE_NAME, "nbr_samples": 1}
        scene["log_token"] = token_of("log")
        log = {"token": token_of("log"), "location": "singapore-onenorth"}
        sample = {"token": token_of("sample"), "scene_token": scene["token"]}
        sample["timestamp"] = round(1e6 * time_s)
        folder = self.root / "v1.0-mini"
        folder.mkdir()
        for name, rows in {**self.rows, "scene": [scene], "sample": [sample], "log": [log]}.items():
            (folder / f"{name}.json").write_text(json.dumps(rows, indent=0))


def _matrix(rows):
    return torch.tensor(rows, dtype=torch.float64)


def draw_key_frame(folder, camera_name="CAM_FRONT"):
    """The overlay of one camera of a key frame, BGR bytes, made through tables and reader."""
    with tempfile.TemporaryDirectory() as place:
        write_key_frame(folder, Path(place) / "log")
        path = ingest_scene("nuscenes", Path(place) / "log", SCENE_NAME, Path(place) / "store")
        scene = DrivingScene.open(path)
        overlay = draw_overlay(scene, scene.view(0, camera_name)).numpy()
    return cv2.cvtColor(overlay, cv2.COLOR_RGB2BGR)


if __name__ == "__main__":
    cv2.imwrite(sys.argv[2], draw_key_frame(sys.argv[1]), [cv2.IMWRITE_JPEG_QUALITY, 80])
