"""Write a `WaymoTruth` as version 2 of the Waymo Open Dataset would hold it: Parquet files."""

import pyarrow as pa
import pyarrow.parquet as pq
from waymo_numbers import (
    CAMERA_NUMBERS,
    LIDAR_NUMBERS,
    SEGMENT,
    camera_numbers,
    frame_numbers,
    lidar_numbers,
)


def write_v2(truth, folder, segment=SEGMENT):
    """One Parquet file per component; gives the folder."""
    for component, table in component_tables(truth, segment).items():
        path = folder / component / f"{segment}.parquet"
        path.parent.mkdir(parents=True, exist_ok=True)
        pq.write_table(table, path, row_group_size=5)
    return folder


def component_tables(truth, segment):
    """The components that the reader joins, as Arrow tables."""
    frames = [frame_numbers(truth, index) for index in truth.scene.frame_indices]
    cameras = [camera_numbers(truth, name) for name in truth.scene.camera_names]
    lidars = [lidar_numbers(truth, name) for name in truth.scene.lidar_names]
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
