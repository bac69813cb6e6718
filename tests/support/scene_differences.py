"""How far two stored scenes are apart, compared in the dataset's own frame."""

from dataclasses import dataclass

import numpy as np
import torch
from scipy.spatial import cKDTree

from lidarpainter_models.geometry.boxes import is_inside_box
from lidarpainter_models.geometry.transforms import transform_points

INTRINSICS = ("fx_px", "fy_px", "cx_px", "cy_px", "width_px", "height_px")


@dataclass(kw_only=True)
class SceneDifferences:
    """The largest differences between a scene and what a reader made of it."""

    camera_centre_m: float = 0.0
    camera_rotation_deg: float = 0.0
    intrinsics: float = 0.0
    num_other_images: int = 0
    point_m: float = 0.0
    """From each point read to the nearest true one, and back."""
    box_centre_m: float = 0.0
    box_rotation_deg: float = 0.0
    box_size_m: float = 0.0
    num_unpaired_boxes: int = 0
    num_points_in_other_boxes: int = 0
    """Of the true points, by their nearest point read."""

    def require_rounding(self, *, metres, point_m, degrees):
        """Refuse more than rounding of poses and points; all else must be as it was."""
        assert self.intrinsics == self.num_other_images == 0
        assert self.num_unpaired_boxes == self.num_points_in_other_boxes == 0
        assert max(self.camera_centre_m, self.box_centre_m) < metres
        assert max(self.camera_rotation_deg, self.box_rotation_deg) < degrees
        assert self.point_m < point_m
        assert self.box_size_m < 1e-6


def scene_differences(truth, read, *, frames=None, camera_names=None):
    """Compare two `DrivingScene`s.

    Args:
        truth: the scene that was written out in a dataset's format.
        read: what the reader made of it.
        frames: pairs (frame of the truth, frame read); equal positions if None.
        camera_names: the truth's camera name by the name read; equal names if None.
    """
    found = SceneDifferences()
    for true_frame, read_frame in frames or zip(
        truth.frame_indices, read.frame_indices, strict=True
    ):
        _compare_views(found, truth, read, true_frame, read_frame, camera_names or {})
        _compare_points_and_boxes(found, truth, read, true_frame, read_frame)
    return found


def _compare_views(found, truth, read, true_frame, read_frame, camera_names):
    expected = {view.camera_name: view for view in truth.views if view.frame_index == true_frame}
    views = [view for view in read.views if view.frame_index == read_frame]
    assert {camera_names.get(view.camera_name, view.camera_name) for view in views} == set(expected)
    for view in views:
        true_view = expected[camera_names.get(view.camera_name, view.camera_name)]
        apart_m, apart_deg = _poses_apart(
            truth.global_from_world @ truth.image_record(true_view).camera.world_from_camera,
            read.global_from_world @ read.image_record(view).camera.world_from_camera,
        )
        found.camera_centre_m = max(found.camera_centre_m, apart_m)
        found.camera_rotation_deg = max(found.camera_rotation_deg, apart_deg)
        for name in INTRINSICS:
            apart = abs(getattr(view.camera, name) - getattr(true_view.camera, name))
            found.intrinsics = max(found.intrinsics, apart)
        found.num_other_images += read.read_jpeg(view) != truth.read_jpeg(true_view)


def _compare_points_and_boxes(found, truth, read, true_frame, read_frame):
    true_points = _global_points(truth, true_frame)
    points = _global_points(read, read_frame)
    there, nearest = cKDTree(points).query(true_points)
    back, _ = cKDTree(true_points).query(points)
    found.point_m = max(found.point_m, float(there.max()), float(back.max()))
    boxes = _boxes_of(truth, true_frame)
    read_boxes = _boxes_of(read, read_frame)
    found.num_unpaired_boxes += len(set(boxes) ^ set(read_boxes))
    for actor_id in set(boxes) & set(read_boxes):
        (pose, size_m), (read_pose, read_size_m) = boxes[actor_id], read_boxes[actor_id]
        apart_m, apart_deg = _poses_apart(pose, read_pose)
        found.box_centre_m = max(found.box_centre_m, apart_m)
        found.box_rotation_deg = max(found.box_rotation_deg, apart_deg)
        found.box_size_m = max(found.box_size_m, float((size_m - read_size_m).abs().max()))
        inside = is_inside_box(torch.from_numpy(true_points), pose, size_m)
        read_inside = is_inside_box(torch.from_numpy(points[nearest]), read_pose, read_size_m)
        found.num_points_in_other_boxes += int((inside != read_inside).sum())


def _global_points(scene, frame_index):
    points = scene.read_points(frame_index).xyz_m.double()
    return transform_points(scene.global_from_world, points).numpy()


def _boxes_of(scene, frame_index):
    return {
        track.actor_id: (scene.global_from_world @ track.world_from_box[row], track.size_m.double())
        for track in scene.tracks
        for row in np.flatnonzero(track.frame_indices.numpy() == frame_index)
    }


def _poses_apart(first, second):
    """Distance of the origins in metres, and the angle between the axes in degrees."""
    apart_m = float((first[:3, 3] - second[:3, 3]).norm())
    turn = first[:3, :3].T @ second[:3, :3]
    sine = torch.stack([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
    angle_rad = torch.atan2(sine.norm() / 2, (turn.trace() - 1) / 2)
    return apart_m, float(angle_rad.rad2deg())
