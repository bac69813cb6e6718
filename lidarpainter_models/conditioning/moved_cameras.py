"""Recorded cameras moved along a trajectory, and what they run into there."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Float, Int
from torch import Tensor

from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.geometry.driven_paths import DrivenPath
from lidarpainter_models.geometry.trajectory_parts import Moments
from lidarpainter_models.geometry.trajectory_specs import Trajectory
from lidarpainter_models.geometry.transforms import invert_rigid
from lidarpainter_models.lidar.collisions import Collision, MovingBody, find_collisions
from lidarpainter_models.lidar.lidar_map import MapPoints
from lidarpainter_models.scenes.actor_names import named_actor, path_of_track
from lidarpainter_models.scenes.driving_scene import DrivingScene, driven_road
from lidarpainter_models.scenes.records import RecordedView, Sweep
from lidarpainter_models.scenes.tracks import ActorTrack


@dataclass(frozen=True, kw_only=True, eq=False)
class MovedCameras:
    """One trajectory through one log."""

    recorded: DrivingScene
    tracks: Sequence[ActorTrack]
    """The moving actors as they are shown; others are as they were recorded."""
    trajectory: Trajectory
    as_rig: bool = False
    """Move the car and its cameras on it, not a camera alone: then a turn is the car's."""

    @cached_property
    def road(self) -> DrivenPath:
        """The way the car drove."""
        return driven_road(self.recorded)

    def moved(self, views: Sequence[RecordedView], cameras: Sequence[Camera]) -> tuple[Camera, ...]:
        """The cameras of some moments of one camera, moved.

        Raises:
            ConfigError: the path leads too far out of the ends of the recorded one.
            SceneError: it names an actor that is not there.
        """
        if self.trajectory.is_recorded:
            return tuple(cameras)
        poses = torch.stack([camera.world_from_camera.double() for camera in cameras])
        moved = self.moved_poses(views, poses)
        return tuple(camera.at(pose) for camera, pose in zip(cameras, moved, strict=True))

    def moved_poses(
        self, views: Sequence[RecordedView | Sweep], poses: Float[Tensor, "views 4 4"]
    ) -> Float[Tensor, "views 4 4"]:
        """World poses, float64, of one sensor at some moments, moved.

        Raises:
            ConfigError: the path leads too far out of the ends of the recorded one.
            SceneError: it names an actor that is not there.
        """
        if self.trajectory.is_recorded:
            return poses
        road, place = self._road_of(views), self.trajectory.placed
        moments = self._moments(views, road)
        if self.as_rig:
            egos = road.world_from_body[moments.rows]
            moved_from_ego = place(egos, road, moments, self._path_of) @ invert_rigid(egos)
            return moved_from_ego @ poses
        return place(poses, road, moments, self._path_of, is_camera=True)

    def collisions(
        self, views: Sequence[RecordedView], cameras: Sequence[Camera], street: MapPoints
    ) -> list[Collision]:
        """What moved cameras run into: points of the street, boxes of moving actors."""
        if self.trajectory.is_recorded:
            return []
        body = MovingBody.camera(
            torch.stack([camera.world_from_camera.double() for camera in cameras]), _times_ns(views)
        )
        start_ns = int(self.road.timestamps_ns[0])
        return find_collisions(body, street, self.tracks, start_ns=start_ns)

    def _road_of(self, views: Sequence[RecordedView | Sweep]) -> DrivenPath:
        """The way that a trajectory leads off."""
        if self.trajectory.other is None:
            return self.road
        times_ns = torch.cat([self.road.timestamps_ns, _times_ns(views)]).unique()
        return self.road.driven_on(times_ns)

    def _moments(self, views: Sequence[RecordedView | Sweep], road: DrivenPath) -> Moments:
        times_ns = _times_ns(views)
        if self.trajectory.other is None:
            frames = [self.recorded.frame_position(view.frame_index) for view in views]
            rows = torch.tensor(frames)
        else:
            rows = torch.searchsorted(road.timestamps_ns, times_ns)
        start_ns, end_ns = (int(self.road.timestamps_ns[row]) for row in (0, -1))
        return Moments(
            rows=rows,
            seconds=(times_ns - start_ns).double() * 1e-9,
            progress=torch.arange(len(views)).double() / max(len(views) - 1, 1),
            log_s=(end_ns - start_ns) * 1e-9,
        )

    def _path_of(self, name: str) -> DrivenPath:
        shown = {track.actor_id: track for track in self.tracks}
        known = {track.actor_id: track for track in self.recorded.tracks} | shown
        return path_of_track(named_actor([*known.values()], name, self.road))


def _times_ns(views: Sequence[RecordedView | Sweep]) -> Int[Tensor, " views"]:
    return torch.tensor([view.timestamp_ns for view in views])
