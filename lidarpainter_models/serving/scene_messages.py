"""What clients are told of a scene: its cameras, the way that was driven, its actors."""

from typing import Any

import torch

from lidarpainter_models.geometry.transforms import interpolate_rigid_track, invert_rigid
from lidarpainter_models.scenes.driving_scene import DrivingScene
from lidarpainter_models.serving.messages import (
    camera_message,
    pose_message,
    trajectory_message,
)
from lidarpainter_models.serving.protos import common_pb2, sensorsim_pb2
from lidarpainter_models.serving.renderer import ServedScene


def driven(served: ServedScene) -> DrivingScene:
    """The recording with its car where the sweeps say it drove."""
    return served.recorded.corrected(served.scene.cameras.path)


def cameras(served: ServedScene) -> Any:  # noqa: ANN401  an AvailableCamerasReturn
    """Every recorded camera: its lens without distortion, and where it sits in the car.

    Its seat is that of the middle of the log.
    """
    reply, car = sensorsim_pb2.AvailableCamerasReturn(), driven(served)
    for name in served.recorded.camera_names:
        views = served.recorded.views_of(name)
        view = views[len(views) // 2]
        world_from_ego = interpolate_rigid_track(
            car.frame_timestamps_ns, car.world_from_ego, view.timestamp_ns
        )
        camera = served.found(view)
        seat = invert_rigid(world_from_ego.double()) @ camera.world_from_camera.double()
        reply.available_cameras.add(
            intrinsics=camera_message(name, camera),
            rig_to_camera=pose_message(seat),
            logical_id=name,
        )
    return reply


def trajectories(served: ServedScene) -> Any:  # noqa: ANN401  an AvailableTrajectoriesReturn
    """The way of the car, at the times of its frames."""
    car = driven(served)
    way = trajectory_message(car.frame_timestamps_ns.tolist(), car.world_from_ego)
    entry = sensorsim_pb2.AvailableTrajectoriesReturn.AvailableTrajectory(trajectory=way)
    return sensorsim_pb2.AvailableTrajectoriesReturn(available_trajectories=[entry])


def ego_masks(scene_id: str, served: ServedScene) -> list[Any]:
    """The cameras that show the recording car itself."""
    bodies = served.scene.cameras.own_bodies
    mask = sensorsim_pb2.AvailableEgoMasksReturn.EgoMaskMetadata
    return [
        mask(ego_mask_id=sensorsim_pb2.EgoMaskId(camera_logical_id=name, rig_config_id=scene_id))
        for name in sorted(bodies)
        if bool(torch.as_tensor(bodies[name]).any())
    ]


def dynamic_objects(served: ServedScene) -> Any:  # noqa: ANN401  a DynamicObjectsReturn
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
