"""What clients are told of a scene: its cameras, the way that was driven, its actors."""

import torch

from lidarpainter_models.export.simulator_bundle import rig_from_camera
from lidarpainter_models.serving.messages import (
    camera_message,
    pose_message,
    trajectory_message,
)
from lidarpainter_models.serving.protos import Message, common_pb2, sensorsim_pb2
from lidarpainter_models.serving.renderer import ServedScene


def cameras(served: ServedScene) -> Message:
    """Every recorded camera: its lens without distortion, and where it sits in the car."""
    reply = sensorsim_pb2.AvailableCamerasReturn()
    for name in served.recorded.camera_names:
        views = served.recorded.views_of(name)
        reply.available_cameras.add(
            intrinsics=camera_message(name, served.found(views[len(views) // 2])),
            rig_to_camera=pose_message(rig_from_camera(served.scene, served.recorded, name)),
            logical_id=name,
        )
    return reply


def trajectories(served: ServedScene) -> Message:
    """The way of the car where the sweeps say that it drove, at the times of its frames."""
    car = served.recorded.corrected(served.scene.cameras.path)
    reply = sensorsim_pb2.AvailableTrajectoriesReturn()
    way = trajectory_message(car.frame_timestamps_ns.tolist(), car.world_from_ego)
    reply.available_trajectories.add(trajectory=way)
    return reply


def add_ego_masks(reply: Message, scene_id: str, served: ServedScene) -> None:
    """Add the cameras that show the recording car itself."""
    for name, body in sorted(served.scene.cameras.own_bodies.items()):
        if bool(torch.as_tensor(body).any()):
            mask = sensorsim_pb2.EgoMaskId(camera_logical_id=name, rig_config_id=scene_id)
            reply.ego_mask_metadata.add(ego_mask_id=mask)


def dynamic_objects(served: ServedScene) -> Message:
    """Every actor with its poses: those that can be moved, and those that are parked."""
    reply = sensorsim_pb2.DynamicObjectsReturn()
    for track in (*served.scene.tracks, *served.parked.values()):
        length_m, width_m, height_m = track.size_m.tolist()
        reply.dynamic_objects.add(
            id=track.actor_id,
            semantic_class=track.category,
            trajectory=trajectory_message(track.timestamps_ns.tolist(), track.world_from_box),
            object_size=common_pb2.AABB(size_x=length_m, size_y=width_m, size_z=height_m),
        )
    return reply
