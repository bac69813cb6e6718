"""What a `WaymoTruth` would be in either release of the Waymo Open Dataset, in plain numbers."""

from dataclasses import dataclass

import numpy as np
import torch
from camera_rows import camera_rows
from scipy.spatial.transform import Rotation
from waymo_truth import NEAR_LIMITS_RAD, TURN_S, moved, top_column

from lidarpainter_models.geometry.transforms import invert_rigid, transform_points

SEGMENT = "1005081002024129653_5313_150_5333_150"
CAMERA_NUMBERS = {"FRONT": 1, "FRONT_LEFT": 2, "FRONT_RIGHT": 3, "SIDE_LEFT": 4, "SIDE_RIGHT": 5}
LIDAR_NUMBERS = {"TOP": 1, "FRONT": 2, "SIDE_LEFT": 3, "SIDE_RIGHT": 4, "REAR": 5}
READOUTS = {"down": 1, "right": 2, "up": 3, "left": 4}
TYPES = {"vehicle": 1, "pedestrian": 2}
SHUTTER_S = 0.0026
LASER_BOX_SHIFT_M = 0.3
"""A box with a camera-synced twin stands this far from it."""
_SENSOR_FROM_CAMERA = np.array([[0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1.0]])


@dataclass
class FrameNumbers:
    """One frame before it is encoded."""

    start_us: int
    pose: list[float]
    images: list[dict]
    lasers: list[dict]
    labels: list[dict]


def frame_numbers(truth, frame_index):
    """Everything of one frame, with range images made from the truth's points."""
    scene = truth.scene
    position = scene.frame_position(frame_index)
    timestamp_ns = int(scene.frame_timestamps_ns[position])
    global_from_ego = scene.global_from_world @ scene.world_from_ego[position]
    return FrameNumbers(
        start_us=round(timestamp_ns / 1e3 - TURN_S / 2 * 1e6),
        pose=global_from_ego.reshape(16).tolist(),
        images=[
            _image(truth, view, timestamp_ns, global_from_ego)
            for view in scene.views
            if view.frame_index == frame_index
        ],
        lasers=[
            _laser(truth, sweep, timestamp_ns, global_from_ego)
            for sweep in scene.sweeps_of(frame_index)
        ],
        labels=_labels(truth, frame_index, global_from_ego),
    )


def camera_numbers(truth, name):
    """The calibration of one camera."""
    view = truth.scene.views_of(name)[0]
    row = camera_rows(truth.scene)[view.index]
    vehicle_from_sensor = truth.vehicle_from_camera[name].numpy() @ _SENSOR_FROM_CAMERA.T
    return {
        "name": name,
        "intrinsic": [
            *(row[term] for term in ("fx_px", "fy_px", "cx_px", "cy_px")),
            *row["distortion_terms"],
        ],
        "extrinsic": vehicle_from_sensor.reshape(16).tolist(),
        "width": row["width_px"],
        "height": row["height_px"],
        "readout": READOUTS[row["rolling_shutter_direction"]],
    }


def lidar_numbers(truth, name):
    """The calibration of one LiDAR; beams are stored from the lowest up."""
    setup = truth.lidars[name]
    beams = [] if setup.beams_rad is None else setup.beams_rad[::-1].tolist()
    limits = NEAR_LIMITS_RAD if setup.beams_rad is None else (beams[0], beams[-1])
    return {
        "name": name,
        "beams": beams,
        "limits": limits,
        "extrinsic": setup.vehicle_from_lidar.reshape(16).tolist(),
    }


def _image(truth, view, timestamp_ns, global_from_ego):
    """An image whose pose is given at another moment than its exposure.

    The pose of FRONT is that of the frame, as in the dataset; the others are 3 ms too early.
    """
    velocity, turn = truth.velocities[view.frame_index]
    exposure_s = (view.timestamp_ns - timestamp_ns) / 1e9
    pose_s = 0.0 if view.camera_name == "FRONT" else exposure_s - 0.003
    readout_s = camera_rows(truth.scene)[view.index]["rolling_shutter_s"]
    middle_s = view.timestamp_ns / 1e9
    half_s = (readout_s + SHUTTER_S) / 2
    return {
        "name": view.camera_name,
        "jpeg": truth.scene.read_jpeg(view),
        "pose": moved(global_from_ego, velocity, turn, pose_s).reshape(16).tolist(),
        "velocity": [*velocity.tolist(), *turn.tolist()],
        "pose_time": timestamp_ns / 1e9 + pose_s,
        "shutter": SHUTTER_S,
        "trigger": middle_s - half_s,
        "done": middle_s + half_s,
    }


def _laser(truth, sweep, timestamp_ns, global_from_ego):
    """Two range images; no pixel may be asked for twice."""
    setup = truth.lidars[sweep.lidar_name]
    points = truth.scene.read_sweep(sweep)
    shape = setup.num_rows, setup.num_columns
    xyz_global_m = transform_points(truth.scene.global_from_world, points.xyz_m.double()).numpy()
    poses = None
    row = points.ring.numpy().astype(int)
    if sweep.lidar_name == "TOP":
        column = top_column(points.time_offset_ns.numpy(), setup.num_columns)
        poses, origins_m = _pixel_poses(truth, timestamp_ns, setup)
        range_m = np.linalg.norm(xyz_global_m - origins_m[column], axis=1)
    else:
        global_from_lidar = global_from_ego.numpy() @ setup.vehicle_from_lidar
        away_m = (xyz_global_m - global_from_lidar[:3, 3]) @ global_from_lidar[:3, :3]
        range_m = np.linalg.norm(away_m, axis=1)
        azimuth = np.arctan2(away_m[:, 1], away_m[:, 0])
        azimuth += np.arctan2(setup.vehicle_from_lidar[1, 0], setup.vehicle_from_lidar[0, 0])
        share = ((np.pi - azimuth) / (2 * np.pi)) % 1.0
        column = np.floor(share * setup.num_columns).astype(int)
    images = np.full((2, *shape, 4), -1.0, dtype=np.float32)
    pixel = points.return_index.numpy().astype(int), row, column
    assert len(set(zip(*(axis.tolist() for axis in pixel), strict=True))) == len(row)
    images[(*pixel, 0)], images[(*pixel, 1)] = range_m, points.intensity.numpy()
    return {"name": sweep.lidar_name, "returns": images, "poses": poses}


def _pixel_poses(truth, timestamp_ns, setup):
    """Roll, pitch, yaw and place of the car at every column, and where the LiDAR then was."""
    poses = np.empty((setup.num_columns, 6))
    origins_m = np.empty((setup.num_columns, 3))
    for column in range(setup.num_columns):
        offset_ns = ((column + 0.5) / setup.num_columns - 0.5) * TURN_S * 1e9
        pose = truth.global_from_ego(timestamp_ns + round(offset_ns)).numpy()
        yaw, pitch, roll = Rotation.from_matrix(pose[:3, :3]).as_euler("ZYX")
        poses[column] = roll, pitch, yaw, *pose[:3, 3]
        origins_m[column] = (pose @ setup.vehicle_from_lidar)[:3, 3]
    tiled = np.broadcast_to(poses.astype(np.float32), (setup.num_rows, *poses.shape))
    return np.ascontiguousarray(tiled), origins_m


def _labels(truth, frame_index, global_from_ego):
    """The boxes of a frame; those that FRONT sees come with a camera-synced twin."""
    labels = []
    ego_from_global = invert_rigid(global_from_ego)
    front = truth.scene.view(frame_index, "FRONT").camera
    for track in truth.scene.tracks:
        for row in np.flatnonzero(track.frame_indices.numpy() == frame_index):
            pose = ego_from_global @ truth.scene.global_from_world @ track.world_from_box[row]
            size_m = track.size_m.double().tolist()
            box = [*pose[:3, 3].tolist(), *size_m, float(torch.atan2(pose[1, 0], pose[0, 0]))]
            centre = track.world_from_box[row, :3, 3][None]
            is_seen = bool(front.contains(*front.project(centre)))
            shifted = [box[0] + LASER_BOX_SHIFT_M, *box[1:]]
            labels.append(
                {
                    "id": track.actor_id,
                    "type": TYPES[track.category],
                    "box": shifted if is_seen else box,
                    "speed": [5.0, 0.0] if track.is_moving else [0.0, 0.0],
                    "synced": ("FRONT", box) if is_seen else None,
                }
            )
    return labels
