"""What the official nuscenes-devkit reads from a log; run by a Python that has it installed.

    python devkit_reading.py ROOT ANSWERS.npz

Writes the pose and lens of every image, the points of every sweep (farther than a metre from the
sensor) and the boxes at every sweep, all in the dataset's global frame.
"""

import sys
from typing import Any

import numpy as np
from nuscenes.nuscenes import NuScenes
from nuscenes.utils.data_classes import LidarPointCloud
from pyquaternion import Quaternion


def matrix(record):
    pose = Quaternion(record["rotation"]).transformation_matrix
    pose[:3, 3] = record["translation"]
    return pose


def global_from_sensor(kit, data):
    global_from_ego = matrix(kit.get("ego_pose", data["ego_pose_token"]))
    return global_from_ego @ matrix(kit.get("calibrated_sensor", data["calibrated_sensor_token"]))


def image_answers(kit, data):
    _, _, lens = kit.get_sample_data(data["token"])
    key = f"{data['timestamp']}/{data['channel']}"
    return {
        f"pose/{key}": global_from_sensor(kit, data),
        f"lens/{key}": lens[[0, 1, 0, 1], [0, 1, 2, 2]],
    }


def sweep_answers(kit, data, position):
    cloud = LidarPointCloud.from_file(kit.get_sample_data_path(data["token"]))
    cloud.points = cloud.points[:, np.linalg.norm(cloud.points[:3], axis=0) >= 1].astype(float)
    cloud.transform(global_from_sensor(kit, data))
    answers = {f"points/{position}": cloud.points[:3].T}
    for box in kit.get_boxes(data["token"]):
        instance = kit.get("sample_annotation", box.token)["instance_token"]
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = box.rotation_matrix, box.center
        size_m = box.wlh[[1, 0, 2]]
        answer = np.concatenate([pose.ravel(), size_m, [data["is_key_frame"]]])
        answers[f"box/{position}/{instance}"] = answer
    return answers


def main(root, path):
    kit = NuScenes("v1.0-mini", root, verbose=False)
    answers: dict[str, Any] = {}
    for data in kit.sample_data:
        if data["channel"].startswith("CAM"):
            answers |= image_answers(kit, data)
    sweeps = [data for data in kit.sample_data if data["channel"] == "LIDAR_TOP"]
    sweeps.sort(key=lambda data: data["timestamp"])
    for position, data in enumerate(sweeps):
        answers |= sweep_answers(kit, data, position)
    np.savez(path, **answers)


if __name__ == "__main__":
    main(*sys.argv[1:])
