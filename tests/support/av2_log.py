"""Write a scene as Argoverse 2 would have published it: Feather tables, JPEG files, sweeps.

Written from the devkit's description (av2, `datasets/sensor/README.md`), not from the reader.

    scene = street_like_av2(folder)     # a synthetic street of 10 Hz, two cameras
    write_av2_log(scene, root, LOG)     # root/LOG/sensors, root/LOG/calibration, ...
"""

from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.feather
import torch
from drawn_streets import recorded_street
from nuscenes_log import FAR_AWAY

from lidarpainter_models.geometry.timed_poses import poses_at
from lidarpainter_models.geometry.transforms import (
    invert_rigid,
    quaternion_from_rotation,
    transform_points,
)
from lidarpainter_models.synthetic import RigCamera

LOG = "00a6ffc1-6ce9-3bc3-a060-6006e9893a1a"
CAMERAS = (
    RigCamera(name="ring_front_center", focal_per_width=1.1, forward_m=1.6, up_m=1.4),
    RigCamera(name="stereo_front_left", focal_per_width=0.8, forward_m=1.6, left_m=0.2, up_m=1.2),
)
HALF_TURN_NS = 50_000_000


def street_like_av2(store):
    """A street seen by two cameras and one LiDAR of 64 beams, far from the city's origin."""
    scene = recorded_street(store, CAMERAS, beams=64)
    scene.manifest["global_from_world"] = FAR_AWAY.reshape(16).tolist()
    return scene


def write_table(file, columns, **options):
    """A Feather file of columns by name."""
    file.parent.mkdir(parents=True, exist_ok=True)
    pa.feather.write_feather(pa.table(columns), file, **options)


def write_av2_log(scene, root, log=LOG, *, coordinate=np.float32):
    """Write a scene below `root`; its one LiDAR counts as two at one place."""
    folder = Path(root) / log
    ego_from_camera = {
        view.camera_name: invert_rigid(_city_from_ego(scene, view.timestamp_ns))
        @ scene.global_from_world
        @ view.camera.world_from_camera
        for view in reversed(scene.views)
    }
    poses = {}
    for view in scene.views:
        camera_pose = scene.global_from_world @ view.camera.world_from_camera
        poses[view.timestamp_ns] = camera_pose @ invert_rigid(ego_from_camera[view.camera_name])
        images = folder / "sensors/cameras" / view.camera_name
        images.mkdir(parents=True, exist_ok=True)
        for time_ns in (view.timestamp_ns, view.timestamp_ns + HALF_TURN_NS):  # 20 Hz
            (images / f"{time_ns}.jpg").write_bytes(scene.read_jpeg(view))
    boxes = []
    for sweep in scene.sweeps:
        start_ns = sweep.timestamp_ns - HALF_TURN_NS
        poses[start_ns] = _city_from_ego(scene, start_ns)
        poses.setdefault(sweep.timestamp_ns, _city_from_ego(scene, sweep.timestamp_ns))
        ego_from_world = invert_rigid(poses[start_ns]) @ scene.global_from_world
        _write_sweep(folder, scene, sweep, ego_from_world, start_ns, coordinate)
        boxes += _boxes(scene, sweep.frame_index, ego_from_world, start_ns)
    times_ns = sorted(poses)
    stacked = torch.stack([poses[time_ns] for time_ns in times_ns])
    write_table(
        folder / "city_SE3_egovehicle.feather", {"timestamp_ns": times_ns, **_pose_columns(stacked)}
    )
    write_table(folder / "annotations.feather", pa.Table.from_pylist(boxes).to_pydict())
    _write_calibration(folder, scene, ego_from_camera)
    map_file = folder / f"map/log_map_archive_{log}____PIT_city_31785.json"
    map_file.parent.mkdir()
    map_file.write_text("{}")
    return folder


def _city_from_ego(scene, time_ns):
    times_ns = scene.frame_timestamps_ns.numpy()
    return (
        scene.global_from_world @ poses_at(scene.world_from_ego, times_ns, np.array([time_ns]))[0]
    )


def _pose_columns(poses):
    rotation = quaternion_from_rotation(poses[:, :3, :3])
    columns = {f"q{axis}": rotation[:, i].tolist() for i, axis in enumerate("wxyz")}
    return columns | {f"t{axis}_m": poses[:, i, 3].tolist() for i, axis in enumerate("xyz")}


def _write_sweep(folder, scene, sweep, ego_from_world, start_ns, coordinate):
    points = scene.read_sweep(sweep)
    xyz_m = transform_points(ego_from_world, points.xyz_m.double()).numpy().astype(coordinate)
    columns = {
        **dict(zip("xyz", xyz_m.T, strict=True)),
        "intensity": points.intensity.round().to(torch.uint8).numpy(),
        "laser_number": points.ring.clamp(0, 63).to(torch.uint8).numpy(),
        "offset_ns": points.time_offset_ns.numpy() + HALF_TURN_NS,
    }
    write_table(folder / f"sensors/lidar/{start_ns}.feather", columns)


def _boxes(scene, frame_index, ego_from_world, start_ns):
    rows = []
    for track in scene.tracks:
        for row in (track.frame_indices == frame_index).nonzero()[:, 0].tolist():
            pose = (ego_from_world @ track.world_from_box[row])[None]
            size_m = dict(
                zip(("length_m", "width_m", "height_m"), track.size_m.tolist(), strict=True)
            )
            columns = {name: values[0] for name, values in _pose_columns(pose).items()}
            rows.append(
                {"timestamp_ns": start_ns, "track_uuid": track.actor_id}
                | {"category": "REGULAR_VEHICLE", **size_m, **columns, "num_interior_pts": 1}
            )
    return rows


def _write_calibration(folder, scene, ego_from_camera):
    ego_from_lidar = invert_rigid(scene.world_from_ego[0]) @ scene.sweeps[0].world_from_lidar
    sensors = {**ego_from_camera, "up_lidar": ego_from_lidar, "down_lidar": ego_from_lidar}
    write_table(
        folder / "calibration/egovehicle_SE3_sensor.feather",
        {"sensor_name": list(sensors), **_pose_columns(torch.stack(list(sensors.values())))},
    )
    lenses = {view.camera_name: view.camera for view in scene.views}
    columns = {
        name: [getattr(camera, name) for camera in lenses.values()]
        for name in ("fx_px", "fy_px", "cx_px", "cy_px", "width_px", "height_px")
    }
    terms = {name: [0.0] * len(lenses) for name in ("k1", "k2", "k3")}
    write_table(
        folder / "calibration/intrinsics.feather", {"sensor_name": list(lenses), **columns, **terms}
    )
