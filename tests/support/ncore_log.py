"""Write a scene as NCore V4 with NVIDIA's own library, as its converters do; not from the reader.

    write_ncore_log(scene, folder, "drive")                        # indexed tar archives, Zarr 2
    write_ncore_log(scene, folder, "drive", store_type="directory", zarr_format=3)

Poses of points are those of the library's own pose graph; boxes stand in the rig, at the end of the
sweep. Every ray has two returns, of which the second one is absent.
"""

import json
from pathlib import Path

import numpy as np
import torch
from ncore.data import (
    BBox3,
    CuboidTrackObservation,
    LabelSource,
    OpenCVPinholeCameraModelParameters,
    ShutterType,
)
from ncore.data.v4 import (
    CameraSensorComponent,
    CuboidsComponent,
    IntrinsicsComponent,
    LidarSensorComponent,
    MasksComponent,
    PosesComponent,
    SequenceComponentGroupsReader,
    SequenceComponentGroupsWriter,
)
from ncore.impl.common.transformations import HalfClosedInterval, PoseGraphInterpolator
from scipy.spatial.transform import Rotation
from upath import UPath

from lidarpainter_models.geometry.transforms import invert_rigid
from lidarpainter_models.readers.source_logs.drive_poses import poses_at

SEQUENCE = "drive-7"
LICENCE = "CC BY 4.0, the street"
HALF_TURN_US = 50_000


def write_ncore_log(
    scene, folder, sequence=SEQUENCE, *, store_type="itar", zarr_format=2, lens=None, told=None
):
    """Write a scene; `lens` makes a camera's model from an image record, `told` the meta data."""
    sweeps_us = [sweep.timestamp_ns // 1000 for sweep in scene.sweeps]
    first_us, last_us = sweeps_us[0] - 2 * HALF_TURN_US, sweeps_us[-1] + 2 * HALF_TURN_US
    writer = SequenceComponentGroupsWriter(
        output_dir_path=UPath(folder),
        store_base_name=sequence,
        sequence_id=sequence,
        sequence_timestamp_interval_us=HalfClosedInterval(first_us, last_us + 1),
        generic_meta_data={"licence": LICENCE} if told is None else told,
        store_type=store_type,
        zarr_format=zarr_format,
    )
    times_us = np.arange(first_us, last_us + 1, 10_000)
    frames_ns = scene.frame_timestamps_ns.numpy()
    rig = poses_at(scene.world_from_ego, frames_ns, times_us * 1000).numpy()
    poses = writer.register_component_writer(PosesComponent.Writer, "default")
    poses.store_dynamic_pose("rig", "world", rig, times_us.astype(np.uint64))
    poses.store_static_pose("world", "world_global", scene.global_from_world.numpy())
    intrinsics = writer.register_component_writer(IntrinsicsComponent.Writer, "default")
    masks = writer.register_component_writer(MasksComponent.Writer, "default")
    edges = [PoseGraphInterpolator.Edge("rig", "world", rig, times_us.astype(np.uint64))]
    for name in scene.camera_names:
        records = [scene.image_record(view) for view in scene.views_of(name)]
        mount = _mount(scene, records[0].timestamp_ns, records[0].camera.world_from_camera)
        poses.store_static_pose(name, "rig", mount)
        intrinsics.store_camera_intrinsics(name, (lens or pinhole)(records[0]))
        masks.store_camera_masks(name, {})
        camera = writer.register_component_writer(CameraSensorComponent.Writer, name, name)
        for view, record in zip(scene.views_of(name), records, strict=True):
            time_us = record.timestamp_ns // 1000
            camera.store_frame(
                scene.read_jpeg(view), "jpeg", np.array([time_us] * 2, np.uint64), {}, {}
            )
    for name in scene.lidar_names:
        sweeps = [sweep for sweep in scene.sweeps if sweep.lidar_name == name]
        mount = _mount(scene, sweeps[0].timestamp_ns, sweeps[0].world_from_lidar)
        poses.store_static_pose(name, "rig", mount)
        edges.append(PoseGraphInterpolator.Edge(name, "rig", mount, None))
        lidar = writer.register_component_writer(LidarSensorComponent.Writer, name, name)
        graph = PoseGraphInterpolator(edges)
        for sweep in sweeps:
            _store_sweep(lidar, graph, scene, sweep)
    boxes = _boxes(scene, PoseGraphInterpolator(edges))
    writer.register_component_writer(CuboidsComponent.Writer, "default").store_observations(boxes)
    stores = SequenceComponentGroupsReader(writer.finalize())
    listed = json.dumps(stores.get_sequence_meta().to_dict(), indent=2)
    Path(folder, f"{sequence}.json").write_text(listed)


def pinhole(record, radial=(0.0,) * 6, shutter=ShutterType.GLOBAL):
    """The model of an image record's camera, with the radial terms that are given."""
    camera = record.camera
    return OpenCVPinholeCameraModelParameters(
        resolution=np.array([camera.width_px, camera.height_px], np.uint64),
        shutter_type=shutter,
        external_distortion_parameters=None,
        principal_point=np.array([camera.cx_px, camera.cy_px], np.float32),
        focal_length=np.array([camera.fx_px, camera.fy_px], np.float32),
        radial_coeffs=np.array(radial, np.float32),
        tangential_coeffs=np.zeros(2, np.float32),
        thin_prism_coeffs=np.zeros(4, np.float32),
    )


def _mount(scene, time_ns, world_from_sensor):
    frames_ns = scene.frame_timestamps_ns.numpy()
    (rig,) = poses_at(scene.world_from_ego, frames_ns, np.array([time_ns]))
    return (invert_rigid(rig) @ world_from_sensor).numpy()


def _store_sweep(lidar, graph, scene, sweep):
    points = scene.read_sweep(sweep)
    times_us = (scene.measured_ns(sweep).numpy() // 1000).astype(np.uint64)
    turns = graph.evaluate_poses("world", sweep.lidar_name, times_us)
    xyz_m = points.xyz_m.double().numpy()
    xyz_m = np.einsum("nij,nj->ni", turns[:, :3, :3], xyz_m) + turns[:, :3, 3]
    distance_m = np.linalg.norm(xyz_m, axis=1)
    absent = np.full(len(xyz_m), np.nan)
    strength = points.intensity.numpy() / 255
    middle_us = sweep.timestamp_ns // 1000
    span_us = middle_us - HALF_TURN_US, middle_us + HALF_TURN_US
    lidar.store_frame(
        direction=(xyz_m / distance_m[:, None]).astype(np.float32),
        timestamp_us=times_us,
        model_element=torch.stack([points.ring, torch.zeros_like(points.ring)], 1)
        .numpy()
        .astype(np.uint16),
        distance_m=np.stack([distance_m, absent]).astype(np.float32),
        intensity=np.stack([strength, absent]).astype(np.float32),
        frame_timestamps_us=np.array(span_us, np.uint64),
        generic_data={},
        generic_meta_data={},
    )


def _boxes(scene, graph):
    ends_us = {
        sweep.frame_index: sweep.timestamp_ns // 1000 + HALF_TURN_US for sweep in scene.sweeps
    }
    found = []
    for track in scene.tracks:
        for row, frame in enumerate(track.frame_indices.tolist()):
            end_us = ends_us[frame]
            rig_from_world = graph.evaluate_poses("world", "rig", np.array(end_us, np.uint64))
            pose = rig_from_world @ track.world_from_box[row].numpy()
            turn = Rotation.from_matrix(pose[:3, :3]).as_euler("xyz")
            found.append(
                CuboidTrackObservation(
                    track_id=track.actor_id,
                    class_id=track.category,
                    timestamp_us=int(track.timestamps_ns[row]) // 1000,
                    reference_frame_id="rig",
                    reference_frame_timestamp_us=end_us,
                    bbox3=BBox3(
                        centroid=tuple(pose[:3, 3].tolist()),
                        dim=tuple(track.size_m.tolist()),
                        rot=tuple(turn.tolist()),
                    ),
                    source=LabelSource.GT_SYNTHETIC,
                )
            )
    return found
