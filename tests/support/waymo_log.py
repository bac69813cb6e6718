"""Write a `WaymoTruth` as the two releases of the Waymo Open Dataset would hold it.

The protobuf messages are put together byte by byte from the field numbers of `dataset.proto` and
`label.proto`, not through the reader's own schema: what both have wrong together would not show.
"""

import struct
import zlib
from dataclasses import dataclass

import google_crc32c
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import torch
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


# --- what either release says, in plain numbers


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
    lens, distortion = truth.scene._lenses[view.index]
    vehicle_from_sensor = truth.vehicle_from_camera[name].numpy() @ _SENSOR_FROM_CAMERA.T
    readout = truth.scene._stored.table("cameras")["rolling_shutter_direction"][view.index].as_py()
    return {
        "name": name,
        "intrinsic": [lens.fx_px, lens.fy_px, lens.cx_px, lens.cy_px, *distortion.terms],
        "extrinsic": vehicle_from_sensor.reshape(16).tolist(),
        "width": lens.width_px,
        "height": lens.height_px,
        "readout": READOUTS[readout],
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
    """A picture whose pose is given at another moment than its exposure.

    The pose of FRONT is that of the frame, as in the dataset; the others are 3 ms too early.
    """
    velocity, turn = truth.velocities[view.frame_index]
    exposure_s = (view.timestamp_ns - timestamp_ns) / 1e9
    pose_s = 0.0 if view.camera_name == "FRONT" else exposure_s - 0.003
    table = truth.scene._stored.table("cameras")
    readout_s = table["rolling_shutter_s"][view.index].as_py()
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


# --- version 1


def tfrecord(records):
    """Records with their lengths and checksums."""
    return b"".join(_framed(record) for record in records)


def write_v1(truth, folder, segment=SEGMENT):
    """One TFRecord file with every frame of the truth; gives its path."""
    path = folder / f"segment-{segment}_with_camera_labels.tfrecord"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(tfrecord(frame_messages(truth, segment)))
    return path


def frame_messages(truth, segment=SEGMENT):
    """The frames as `Frame` messages."""
    context = context_message(truth, segment)
    return [
        frame_message(frame_numbers(truth, index), context) for index in truth.scene.frame_indices
    ]


def context_message(truth, segment=SEGMENT):
    """Name and calibrations, which every frame repeats."""
    cameras = [camera_numbers(truth, name) for name in truth.scene.camera_names]
    lidars = [lidar_numbers(truth, name) for name in truth.scene.lidar_names]
    return context_of(cameras, lidars, segment)


def context_of(cameras, lidars, segment=SEGMENT):
    """The context of calibrations in plain numbers."""
    return b"".join(
        [
            text(1, segment),
            *[message(2, camera_message(camera)) for camera in cameras],
            *[message(3, lidar_message(lidar)) for lidar in lidars],
        ]
    )


def camera_message(camera):
    return b"".join(
        [
            whole(1, CAMERA_NUMBERS[camera["name"]]),
            *[double(2, number) for number in camera["intrinsic"]],
            message(3, transform(camera["extrinsic"])),
            whole(4, camera["width"]),
            whole(5, camera["height"]),
            whole(6, camera["readout"]),
        ]
    )


def lidar_message(lidar):
    return b"".join(
        [
            whole(1, LIDAR_NUMBERS[lidar["name"]]),
            *[double(2, number) for number in lidar["beams"]],
            double(3, lidar["limits"][0]),
            double(4, lidar["limits"][1]),
            message(5, transform(lidar["extrinsic"])),
        ]
    )


def frame_message(frame, context):
    return b"".join(
        [
            message(1, context),
            whole(2, frame.start_us),
            message(3, transform(frame.pose)),
            *[message(4, image_message(image)) for image in frame.images],
            *[message(5, laser_message(laser)) for laser in frame.lasers],
            *[message(6, label_message(label)) for label in frame.labels],
            message(7, double(1, 3.5) + text(3, "a no-label zone, which nobody reads")),
        ]
    )


def image_message(image):
    linear, angular = image["velocity"][:3], image["velocity"][3:]
    velocity = [single(number, value) for number, value in enumerate(linear, start=1)]
    velocity += [double(number, value) for number, value in enumerate(angular, start=4)]
    return b"".join(
        [
            whole(1, CAMERA_NUMBERS[image["name"]]),
            message(2, image["jpeg"]),
            message(3, transform(image["pose"])),
            message(4, b"".join(velocity)),
            double(5, image["pose_time"]),
            double(6, image["shutter"]),
            double(7, image["trigger"]),
            double(8, image["done"]),
        ]
    )


def laser_message(laser):
    first, second = (message(2, zlib.compress(matrix(image), 1)) for image in laser["returns"])
    if laser["poses"] is not None:
        first += message(4, zlib.compress(matrix(laser["poses"]), 1))
    return whole(1, LIDAR_NUMBERS[laser["name"]]) + message(2, first) + message(3, second)


def label_message(label):
    parts = [
        message(1, box_message(label["box"])),
        message(2, double(1, label["speed"][0]) + double(2, label["speed"][1])),
        whole(3, label["type"]),
        text(4, label["id"]),
    ]
    if label["synced"] is not None:
        parts += [text(11, label["synced"][0]), message(12, box_message(label["synced"][1]))]
    return b"".join(parts)


def box_message(numbers):
    x, y, z, length, width, height, heading = numbers
    fields = ((1, x), (2, y), (3, z), (5, length), (4, width), (6, height), (7, heading))
    return b"".join(double(number, value) for number, value in fields)


def matrix(values):
    """A `MatrixFloat`: packed numbers, then the shape."""
    dims = b"".join(whole(1, size) for size in values.shape)
    return message(1, values.astype("<f4").tobytes()) + message(2, dims)


def transform(numbers):
    return b"".join(double(1, number) for number in numbers)


def whole(number, value):
    return varint(number << 3) + varint(value)


def double(number, value):
    return varint(number << 3 | 1) + struct.pack("<d", value)


def single(number, value):
    return varint(number << 3 | 5) + struct.pack("<f", value)


def text(number, value):
    return message(number, value.encode())


def message(number, content):
    return varint(number << 3 | 2) + varint(len(content)) + content


def varint(value):
    content = bytearray()
    while value > 0x7F:
        content.append(value & 0x7F | 0x80)
        value >>= 7
    content.append(value)
    return bytes(content)


def _framed(content):
    length = struct.pack("<Q", len(content))
    return length + _checksum(length) + content + _checksum(content)


def _checksum(content):
    checksum = google_crc32c.value(content)
    turned = (checksum >> 15 | checksum << 17) & 0xFFFFFFFF
    return struct.pack("<I", (turned + 0xA282EAD8) & 0xFFFFFFFF)


# --- version 2


def write_v2(truth, folder, segment=SEGMENT, *, rows_per_group=5):
    """One Parquet file per component; gives the folder."""
    for component, table in component_tables(truth, segment).items():
        path = folder / component / f"{segment}.parquet"
        path.parent.mkdir(parents=True, exist_ok=True)
        pq.write_table(table, path, row_group_size=rows_per_group)
    return folder


def component_tables(truth, segment=SEGMENT):
    """The components that the reader joins, as Arrow tables."""
    frames = [frame_numbers(truth, index) for index in truth.scene.frame_indices]
    cameras = [camera_numbers(truth, name) for name in truth.scene.camera_names]
    lidars = [lidar_numbers(truth, name) for name in truth.scene.lidar_names]
    return component_tables_of(frames, cameras, lidars, segment)


def component_tables_of(frames, cameras, lidars, segment):
    """The components of frames and calibrations in plain numbers."""
    rows = {
        "vehicle_pose": [
            {**_key(frame), "[VehiclePoseComponent].world_from_vehicle.transform": frame.pose}
            for frame in frames
        ],
        "camera_calibration": [_camera_row(camera) for camera in cameras],
        "lidar_calibration": [_lidar_row(lidar) for lidar in lidars],
        "camera_image": [
            _image_row(_key(frame), image) for frame in frames for image in frame.images
        ],
        "lidar": [_laser_row(_key(frame), laser) for frame in frames for laser in frame.lasers],
        "lidar_pose": [
            _pose_row(_key(frame), laser)
            for frame in frames
            for laser in frame.lasers
            if laser["poses"] is not None
        ],
        "lidar_box": [_label_row(_key(frame), label) for frame in frames for label in frame.labels],
        "lidar_camera_synced_box": [
            _synced_row(_key(frame), label)
            for frame in frames
            for label in frame.labels
            if label["synced"] is not None
        ],
    }
    return {
        component: _table([{"key.segment_context_name": segment, **row} for row in found])
        for component, found in rows.items()
    }


def _key(frame):
    return {"key.frame_timestamp_micros": frame.start_us}


def _camera_row(camera):
    prefix = "[CameraCalibrationComponent]."
    names = ("f_u", "f_v", "c_u", "c_v", "k1", "k2", "p1", "p2", "k3")
    lens = zip(names, camera["intrinsic"], strict=True)
    return {
        "key.camera_name": CAMERA_NUMBERS[camera["name"]],
        **{f"{prefix}intrinsic.{name}": value for name, value in lens},
        f"{prefix}extrinsic.transform": camera["extrinsic"],
        f"{prefix}width": camera["width"],
        f"{prefix}height": camera["height"],
        f"{prefix}rolling_shutter_direction": camera["readout"],
    }


def _lidar_row(lidar):
    prefix = "[LiDARCalibrationComponent]."
    return {
        "key.laser_name": LIDAR_NUMBERS[lidar["name"]],
        f"{prefix}extrinsic.transform": lidar["extrinsic"],
        f"{prefix}beam_inclination.min": lidar["limits"][0],
        f"{prefix}beam_inclination.max": lidar["limits"][1],
        f"{prefix}beam_inclination.values": lidar["beams"] or None,
    }


def _image_row(key, image):
    prefix = "[CameraImageComponent]."
    names = [f"{kind}_velocity.{axis}" for kind in ("linear", "angular") for axis in "xyz"]
    velocity = zip(names, image["velocity"], strict=True)
    return {
        **key,
        "key.camera_name": CAMERA_NUMBERS[image["name"]],
        f"{prefix}image": image["jpeg"],
        f"{prefix}pose.transform": image["pose"],
        **{f"{prefix}velocity.{name}": value for name, value in velocity},
        f"{prefix}pose_timestamp": image["pose_time"],
        f"{prefix}rolling_shutter_params.shutter": image["shutter"],
        f"{prefix}rolling_shutter_params.camera_trigger_time": image["trigger"],
        f"{prefix}rolling_shutter_params.camera_readout_done_time": image["done"],
    }


def _laser_row(key, laser):
    row = {**key, "key.laser_name": LIDAR_NUMBERS[laser["name"]]}
    for number, image in enumerate(laser["returns"], start=1):
        row.update(_matrix_columns(f"[LiDARComponent].range_image_return{number}", image))
    return row


def _pose_row(key, laser):
    poses = _matrix_columns("[LiDARPoseComponent].range_image_return1", laser["poses"])
    return {**key, "key.laser_name": LIDAR_NUMBERS[laser["name"]], **poses}


def _matrix_columns(prefix, values):
    return {f"{prefix}.values": values.ravel(), f"{prefix}.shape": list(values.shape)}


def _label_row(key, label):
    prefix = "[LiDARBoxComponent]."
    return {
        **key,
        "key.laser_object_id": label["id"],
        **_box_columns(f"{prefix}box", label["box"]),
        f"{prefix}type": label["type"],
        f"{prefix}speed.x": label["speed"][0],
        f"{prefix}speed.y": label["speed"][1],
    }


def _synced_row(key, label):
    prefix = "[LiDARCameraSyncedBoxComponent]."
    camera, box = label["synced"]
    return {
        **key,
        "key.laser_object_id": label["id"],
        f"{prefix}most_visible_camera_name": CAMERA_NUMBERS[camera],
        **_box_columns(f"{prefix}camera_synced_box", box),
    }


def _box_columns(prefix, box):
    names = ("center.x", "center.y", "center.z", "size.x", "size.y", "size.z", "heading")
    return {f"{prefix}.{name}": value for name, value in zip(names, box, strict=True)}


def _table(rows):
    columns = {name: [row[name] for row in rows] for name in rows[0]}
    return pa.table(
        {name: pa.array(values, type=_arrow_type(name)) for name, values in columns.items()}
    )


def _arrow_type(name):
    """The types of the dataset's columns (2.0.1)."""
    by_ending = {
        "segment_context_name": pa.string(),
        "frame_timestamp_micros": pa.int64(),
        "laser_object_id": pa.string(),
        "inclination.values": pa.list_(pa.float64()),
        ".values": pa.list_(pa.float32()),
        ".shape": pa.list_(pa.int32(), 3),
        ".transform": pa.list_(pa.float64(), 16),
        ".image": pa.binary(),
        ".width": pa.int32(),
        ".height": pa.int32(),
        "_name": pa.int8(),
        ".type": pa.int8(),
        "_direction": pa.int8(),
        ".linear_velocity.x": pa.float32(),
        ".linear_velocity.y": pa.float32(),
        ".linear_velocity.z": pa.float32(),
    }
    return next((kind for end, kind in by_ending.items() if name.endswith(end)), pa.float64())
