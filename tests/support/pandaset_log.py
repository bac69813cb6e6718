"""Write a canonical scene as PandaSet would have published it.

What the format cannot hold is lost: rings, echoes and box times. Its boxes turn about the vertical
only: a scene whose boxes lean is refused, `set_boxes_upright` makes one that can be written, and
the dataset's frame must share its z with the scene's world. Classes, point times, camera
poses and images are kept to the last digit of float64 seconds and metres.
"""

import gzip
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from pickled_tables import pickled_table

from lidarpainter_models.geometry.transforms import (
    quaternion_from_rotation,
    rigid_from_rotation,
    rotation_from_vector,
    transform_points,
)

CAMERA_NAMES = (
    *("front_camera", "front_left_camera", "front_right_camera"),
    *("left_camera", "right_camera", "back_camera"),
)
# x right, y forward, z up as the dataset's vehicle has it, seen from x forward, y left, z up
EGO_FROM_VEHICLE = torch.tensor(
    [[0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]], dtype=torch.float64
)


def far_away_frame(yaw_rad=2.2, position_m=(-2310.25, 1734.5, 61.75)):
    """A dataset's frame from a scene's world: far from the origin, turned about the vertical."""
    turn = torch.tensor([0.0, 0.0, yaw_rad], dtype=torch.float64)
    return rigid_from_rotation(
        rotation_from_vector(turn), torch.tensor(position_m, dtype=torch.float64)
    )


def set_boxes_upright(scene):
    """Turn the boxes of an open scene so that none leans; headings and places stay."""
    scene.tracks = tuple(
        replace(track, world_from_box=torch.stack([_upright(p) for p in track.world_from_box]))
        for track in scene.tracks
    )


def _upright(world_from_box):
    turn = torch.zeros(3, dtype=torch.float64)
    turn[2] = torch.atan2(world_from_box[1, 0], world_from_box[0, 0])
    return rigid_from_rotation(rotation_from_vector(turn), world_from_box[:3, 3])


def write_pandaset_log(scene, root, sequence="001"):
    """Write a `DrivingScene` with PandaSet's camera names below `root`; gives the folder."""
    folder = Path(root) / sequence
    frames = list(enumerate(scene.frame_indices))
    _write_json(folder / "lidar/timestamps.json", _seconds(scene.frame_timestamps_ns.tolist()))
    poses = [_pose(scene, pose @ EGO_FROM_VEHICLE) for pose in scene.world_from_ego]
    _write_json(folder / "lidar/poses.json", poses)
    for name in scene.camera_names:
        _write_camera(scene, name, folder / "camera" / name)
    classes = {str(number): name for number, name in scene.semantic_classes.items()}
    _write_json(folder / "annotations/semseg/classes.json", classes)
    for position, frame_index in frames:
        _write_points(scene, frame_index, folder, f"{position:02d}.pkl.gz")
        columns = _box_columns(scene, frame_index)
        _write_table(folder / f"annotations/cuboids/{position:02d}.pkl.gz", columns)
    return folder


def _write_camera(scene, name, folder):
    views = scene.views_of(name)
    camera = views[0].camera
    lens = {key: getattr(camera, f"{key}_px") for key in ("fx", "fy", "cx", "cy")}
    _write_json(folder / "intrinsics.json", lens)
    _write_json(folder / "timestamps.json", _seconds([view.timestamp_ns for view in views]))
    poses = [_pose(scene, view.camera.world_from_camera) for view in views]
    _write_json(folder / "poses.json", poses)
    for position, view in enumerate(views):
        (folder / f"{position:02d}.jpg").write_bytes(scene.read_jpeg(view))


def _write_points(scene, frame_index, folder, name):
    points = scene.read_points(frame_index)
    xyz_m = transform_points(scene.global_from_world, points.xyz_m.double()).numpy()
    times_ns = [
        sweep.timestamp_ns + scene.read_sweep(sweep).time_offset_ns.numpy().astype(np.int64)
        for sweep in scene.sweeps_of(frame_index)
    ]
    columns = {
        **dict(zip("xyz", xyz_m.T, strict=True)),
        "i": points.intensity.numpy().astype(np.float64),
        "t": np.concatenate(times_ns) / 1e9,
        "d": points.lidar.numpy().astype(np.int64),
    }
    _write_table(folder / "lidar" / name, columns)
    classes = scene.read_semantics(frame_index).numpy().astype(np.int64)
    _write_table(folder / "annotations/semseg" / name, {"class": classes})


def _box_columns(scene, frame_index):
    boxes = [
        (track, scene.global_from_world @ track.world_from_box[row])
        for track in scene.tracks
        for row in (track.frame_indices == frame_index).nonzero()[:, 0].tolist()
    ]
    if any(float(pose[2, 2]) < 1 - 1e-9 for _, pose in boxes):
        raise ValueError("PandaSet cannot hold boxes that lean")
    sizes_m = np.array([track.size_m.tolist() for track, _ in boxes]).reshape(-1, 3)
    headings_rad = np.array([torch.atan2(pose[1, 0], pose[0, 0]) for _, pose in boxes])
    return {
        "uuid": np.array([track.actor_id for track, _ in boxes], dtype=object),
        "label": np.array([track.category for track, _ in boxes], dtype=object),
        "yaw": headings_rad - np.pi / 2,  # the dataset's length lies along the box's y
        "stationary": np.array([not track.is_moving for track, _ in boxes], dtype=bool),
        **{
            f"position.{axis}": np.array([float(pose[index, 3]) for _, pose in boxes])
            for index, axis in enumerate("xyz")
        },
        "dimensions.x": sizes_m[:, 1],
        "dimensions.y": sizes_m[:, 0],
        "dimensions.z": sizes_m[:, 2],
        "cuboids.sensor_id": np.full(len(boxes), -1),
        "cuboids.sibling_id": np.array(["-"] * len(boxes), dtype=object),
    }


def _pose(scene, world_from_body):
    pose = scene.global_from_world @ world_from_body
    heading = quaternion_from_rotation(pose[:3, :3]).tolist()
    return {
        "position": dict(zip("xyz", pose[:3, 3].tolist(), strict=True)),
        "heading": dict(zip("wxyz", heading, strict=True)),
    }


def _seconds(timestamps_ns):
    return [timestamp_ns / 1e9 for timestamp_ns in timestamps_ns]


def _write_json(file, value):
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(json.dumps(value))


def _write_table(file, columns):
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_bytes(gzip.compress(pickled_table(columns), compresslevel=1, mtime=0))
