"""Write a scene as nuScenes would have recorded it: tables of v1.0, images, `.pcd.bin` sweeps.

Written from the dataset's published schema, not from the reader: what both agree on is the format.
The nuScenes devkit opens the result.

    scene = street_like_nuscenes(folder)          # a synthetic street, its boxes as nuScenes' hold
    write_nuscenes_log(scene, root, key_every=3)  # root/v1.0-mini, root/samples, root/sweeps
"""

import copy
import hashlib
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from drawn_streets import recorded_street

from lidarpainter_models.geometry.transforms import (
    interpolate_rigid,
    interpolate_rigid_track,
    invert_rigid,
    quaternion_from_rotation,
    rigid_from_rotation,
    rotation_from_vector,
    transform_points,
)
from lidarpainter_models.synthetic import RigCamera

HALF_TURN_US = 25_000
SCENE_NAME = "scene-0061"
LOG_NAME = "n015-2018-07-24-11-22-45+0800"
CAMERAS = tuple(
    RigCamera(
        name=f"CAM_{name}",
        focal_per_width=focal,
        yaw_rad=float(np.radians(yaw_deg)),
        forward_m=forward_m,
        left_m=left_m,
        up_m=1.5,
    )
    for name, focal, yaw_deg, forward_m, left_m in (
        ("FRONT", 0.79, 0, 1.7, 0.0),
        ("FRONT_LEFT", 0.8, 55, 1.5, 0.5),
        ("FRONT_RIGHT", 0.79, -55, 1.5, -0.5),
        ("BACK", 0.5, 180, 0.0, 0.0),
        ("BACK_LEFT", 0.79, 110, 1.0, 0.5),
        ("BACK_RIGHT", 0.79, -110, 1.0, -0.5),
    )
)
# sensor axes x right, y forward, z up, on the roof and a little tilted
EGO_FROM_LIDAR = rigid_from_rotation(
    torch.tensor([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
    @ rotation_from_vector(torch.tensor([0.01, -0.02, 0.003], dtype=torch.float64)),
    torch.tensor([0.94, 0.0, 1.84], dtype=torch.float64),
)
FAR_AWAY = rigid_from_rotation(
    rotation_from_vector(torch.tensor([0.002, -0.003, 2.3], dtype=torch.float64)),
    torch.tensor([1411.3, -1180.9, 12.5], dtype=torch.float64),
)
"""`global_from_world` with a heading, a slope and a place of its own."""


def street_like_nuscenes(store):
    """A street seen by six cameras and a LiDAR of 20 Hz, its boxes at the moments they are seen."""
    scene = recorded_street(store, CAMERAS, num_frames=7, frame_interval_s=0.05)
    scene.manifest["global_from_world"] = FAR_AWAY.reshape(16).tolist()
    scene.tracks = tuple(_when_seen(track, scene) for track in scene.tracks)
    return scene


def reduced(scene, *, num_frames, cameras, num_actors):
    """The first frames of a scene, some cameras, and the actors with the most points."""
    small = copy.copy(scene)
    small.frame_indices = scene.frame_indices[:num_frames]
    small.frame_timestamps_ns = scene.frame_timestamps_ns[:num_frames]
    small.world_from_ego = scene.world_from_ego[:num_frames]
    small.views = tuple(
        view
        for view in scene.views
        if view.camera_name in cameras and view.frame_index in small.frame_indices
    )
    small.sweeps = tuple(s for s in scene.sweeps if s.frame_index in small.frame_indices)
    ranked = sorted(scene.tracks, key=lambda track: -int(track.num_points[:num_frames].min()))
    small.tracks = tuple(
        replace(
            track,
            frame_indices=track.frame_indices[:num_frames],
            timestamps_ns=track.timestamps_ns[:num_frames],
            world_from_box=track.world_from_box[:num_frames],
            num_points=track.num_points[:num_frames],
        )
        for track in ranked[:num_actors]
    )
    return small


def write_nuscenes_log(scene, root, *, key_every=3, version="v1.0-mini", name=SCENE_NAME):
    """Write a scene below `root`; every so many frames is a key frame, only these have boxes."""
    log = _Log(scene, Path(root), name, key_every)
    log.write_sensors()
    for position in range(len(scene.frame_indices)):
        log.write_frame(position)
    log.write_annotations()
    log.write_the_rest()
    log.link()
    folder = Path(root) / version
    folder.mkdir(parents=True, exist_ok=True)
    for table, rows in log.tables.items():
        (folder / f"{table}.json").write_text(json.dumps(rows, indent=0))


def token_of(*parts):
    """32 hexadecimal digits, as nuScenes' tokens are."""
    return hashlib.blake2b("/".join(map(str, parts)).encode(), digest_size=16).hexdigest()


class _Log:
    def __init__(self, scene, root, name, key_every):
        self.scene, self.root, self.name, self.key_every = scene, root, name, key_every
        names = "scene sample sample_data sample_annotation ego_pose calibrated_sensor sensor"
        names += " instance category attribute visibility log map"
        self.tables: dict[str, list[dict[str, Any]]] = {table: [] for table in names.split()}
        self.ends_us = [end_us(scene, position) for position in range(len(scene.frame_indices))]
        self.keys = list(range(0, len(self.ends_us), key_every))

    def sample_of(self, position):
        """A sweep in between belongs to the next key frame, or else to the last."""
        following = [key for key in self.keys if key >= position]
        return token_of(self.name, "sample", following[0] if following else self.keys[-1])

    def write_sensors(self):
        camera_of = {view.camera_name: view for view in reversed(self.scene.views)}
        self.ego_from_sensor = {"LIDAR_TOP": EGO_FROM_LIDAR, "RADAR_FRONT": EGO_FROM_LIDAR}
        for channel, view in camera_of.items():
            global_from_ego = ego_at(self.scene, view.timestamp_ns)
            pose = self.scene.global_from_world @ view.camera.world_from_camera
            self.ego_from_sensor[channel] = invert_rigid(global_from_ego) @ pose
        for channel, pose in self.ego_from_sensor.items():
            modality = {"C": "camera", "L": "lidar", "R": "radar"}[channel[0]]
            row = {"token": token_of(channel), "channel": channel, "modality": modality}
            self.tables["sensor"].append(row)
            lens = camera_of[channel].camera if channel in camera_of else None
            row = {
                "token": token_of(self.name, channel),
                "sensor_token": token_of(channel),
                **written_pose(pose),
                "camera_intrinsic": [
                    [lens.fx_px, 0.0, lens.cx_px],
                    [0.0, lens.fy_px, lens.cy_px],
                    [0.0, 0.0, 1.0],
                ]
                if lens
                else [],
            }
            self.tables["calibrated_sensor"].append(row)

    def write_frame(self, position):
        scene, is_key = self.scene, position % self.key_every == 0
        frame_index = scene.frame_indices[position]
        if is_key:
            row = {"token": self.sample_of(position), "timestamp": self.ends_us[position]}
            row["scene_token"] = token_of(self.name)
            self.tables["sample"].append(row)
        for view in scene.views:
            if view.frame_index == frame_index:
                pose = scene.global_from_world @ view.camera.world_from_camera
                global_from_ego = pose @ invert_rigid(self.ego_from_sensor[view.camera_name])
                time_us = view.timestamp_ns // 1000
                row = self._data_row(view.camera_name, position, time_us, global_from_ego)
                row |= {"width": view.camera.width_px, "height": view.camera.height_px}
                self._write(row["filename"], scene.read_jpeg(view))
        global_from_ego = ego_at(scene, 1000 * self.ends_us[position])
        row = self._data_row("LIDAR_TOP", position, self.ends_us[position], global_from_ego)
        self._write(row["filename"], self._cloud(frame_index, global_from_ego))
        if is_key:
            self._data_row("RADAR_FRONT", position, self.ends_us[position] - 7, global_from_ego)

    def _data_row(self, channel, position, time_us, global_from_ego):
        is_key = position % self.key_every == 0
        folder, ending = "samples" if is_key else "sweeps", ".jpg"
        if not channel.startswith("CAM"):
            ending = ".pcd.bin" if channel.startswith("LIDAR") else ".pcd"
        row = {
            "token": token_of(self.name, channel, time_us),
            "sample_token": self.sample_of(position),
            "ego_pose_token": token_of(self.name, channel, time_us),
            "calibrated_sensor_token": token_of(self.name, channel),
            "timestamp": time_us,
            "fileformat": ending[1:4],
            "is_key_frame": is_key,
            "height": 0,
            "width": 0,
            "filename": f"{folder}/{channel}/{LOG_NAME}__{channel}__{time_us}{ending}",
        }
        self.tables["sample_data"].append(row)
        pose = {"token": row["ego_pose_token"], "timestamp": time_us}
        self.tables["ego_pose"].append(pose | written_pose(global_from_ego))
        return row

    def _cloud(self, frame_index, global_from_ego):
        """Points in the sensor's frame at the sweep's time, and firings that met nothing."""
        points = self.scene.read_points(frame_index)
        lidar_from_world = (
            invert_rigid(global_from_ego @ EGO_FROM_LIDAR) @ self.scene.global_from_world
        )
        rows = np.zeros((points.num_points + 50, 5), "<f4")
        rows[: points.num_points, :3] = transform_points(lidar_from_world, points.xyz_m.double())
        rows[: points.num_points, 3] = (255 * points.intensity).round()
        rows[: points.num_points, 4] = points.ring.clamp(min=0)
        rows[points.num_points :, 1] = np.linspace(-0.45, 0, 50)
        return rows.tobytes()

    def write_annotations(self):
        categories = sorted({track.category for track in self.scene.tracks})
        for category in categories:
            row = {"token": token_of("category", category), "name": category, "description": ""}
            self.tables["category"].append(row)
        for track in self.scene.tracks:
            length_m, width_m, height_m = track.size_m.double().tolist()
            for seen, frame_index in enumerate(track.frame_indices.tolist()):
                position = self.scene.frame_indices.index(frame_index)
                if position % self.key_every == 0:
                    pose = self.scene.global_from_world @ track.world_from_box[seen]
                    annotation = {
                        "token": token_of(self.name, track.actor_id, position),
                        "sample_token": self.sample_of(position),
                        "instance_token": track.actor_id,
                        "visibility_token": "4",
                        "attribute_tokens": [],
                        **written_pose(pose),
                        "size": [width_m, length_m, height_m],
                        "num_lidar_pts": int(track.num_points[seen]),
                        "num_radar_pts": 0,
                    }
                    self.tables["sample_annotation"].append(annotation)
            own = [
                row["token"]
                for row in self.tables["sample_annotation"]
                if row["instance_token"] == track.actor_id
            ]
            instance = {
                "token": track.actor_id,
                "category_token": token_of("category", track.category),
                "nbr_annotations": len(own),
                "first_annotation_token": own[0],
                "last_annotation_token": own[-1],
            }
            self.tables["instance"].append(instance)

    def write_the_rest(self):
        samples = self.tables["sample"]
        scene = {
            "token": token_of(self.name),
            "log_token": token_of("log"),
            "nbr_samples": len(samples),
            "first_sample_token": samples[0]["token"],
            "last_sample_token": samples[-1]["token"],
            "name": self.name,
            "description": "a synthetic street",
        }
        self.tables["scene"].append(scene)
        log = {"token": token_of("log"), "logfile": LOG_NAME, "vehicle": "n015"}
        log |= {"date_captured": "2018-07-24", "location": "singapore-onenorth"}
        self.tables["log"].append(log)
        plan = {"token": token_of("map"), "log_tokens": [token_of("log")]}
        plan |= {"category": "semantic_prior", "filename": "maps/street.png"}
        self.tables["map"].append(plan)
        self._write(plan["filename"], cv2.imencode(".png", np.zeros((4, 4), np.uint8))[1].tobytes())
        level = {"token": "4", "level": "v80-100", "description": "80 to 100 % visible"}
        self.tables["visibility"].append(level)

    def link(self):
        """Fill in `prev` and `next`, by time within each chain."""
        chains = (
            ("sample", "scene_token"),
            ("sample_data", "calibrated_sensor_token"),
            ("sample_annotation", "instance_token"),
        )
        for table, key in chains:
            for value in {row[key] for row in self.tables[table]}:
                chain = [row for row in self.tables[table] if row[key] == value]
                for position, row in enumerate(chain):
                    row["prev"] = chain[position - 1]["token"] if position else ""
                    row["next"] = chain[position + 1]["token"] if row is not chain[-1] else ""

    def _write(self, name, content):
        path = self.root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)


def end_us(scene, position):
    """When the turn of a frame's sweep ends; the street states its middle."""
    sweep = scene.sweeps_of(scene.frame_indices[position])[0]
    return sweep.timestamp_ns // 1000 + HALF_TURN_US


def ego_at(scene, timestamp_ns):
    """`global_from_ego`; the last motion goes on after the last frame."""
    times_ns, poses = scene.frame_timestamps_ns, scene.world_from_ego
    if timestamp_ns <= int(times_ns[-1]):
        return scene.global_from_world @ interpolate_rigid_track(times_ns, poses, timestamp_ns)
    beyond = 2 * int(times_ns[-1]) - timestamp_ns
    mirrored = interpolate_rigid_track(times_ns, poses, beyond)
    return scene.global_from_world @ poses[-1] @ invert_rigid(mirrored) @ poses[-1]


def written_pose(target_from_source):
    """As the tables hold it: x y z and the quaternion w x y z."""
    return {
        "translation": target_from_source[:3, 3].tolist(),
        "rotation": quaternion_from_rotation(target_from_source[:3, :3]).tolist(),
    }


def _when_seen(track, scene):
    """A track whose boxes stand where and when the LiDAR, turning clockwise, looked at them.

    The actor goes from its first to its last place at one speed: boxes of key frames say no more
    about the time between them.
    """
    times_ns, poses = [], []
    for frame_index in track.frame_indices.tolist():
        ends_ns = 1000 * end_us(scene, scene.frame_indices.index(frame_index))
        lidar_from_global = invert_rigid(ego_at(scene, ends_ns) @ EGO_FROM_LIDAR)
        time_ns, pose = ends_ns, _uniformly(track, ends_ns)
        for _ in range(6 if track.is_moving else 1):
            x, y, _z, _one = lidar_from_global @ scene.global_from_world @ pose[:, 3]
            from_left_clockwise = (np.pi - np.arctan2(float(y), float(x))) % (2 * np.pi)
            turned = from_left_clockwise / (2 * np.pi)
            time_ns = ends_ns - round((1 - turned) * 2 * HALF_TURN_US * 1000)
            pose = _uniformly(track, time_ns)
        times_ns.append(time_ns)
        poses.append(pose)
    return replace(track, timestamps_ns=torch.tensor(times_ns), world_from_box=torch.stack(poses))


def _uniformly(track, time_ns):
    first_ns, last_ns = int(track.timestamps_ns[0]), int(track.timestamps_ns[-1])
    share = torch.tensor((time_ns - first_ns) / (last_ns - first_ns), dtype=torch.float64)
    return interpolate_rigid(track.world_from_box[0], track.world_from_box[-1], share)
