"""A fitted scene being edited: actors come out of it whole and are put in elsewhere.

Every edit is one of both, or both; what has stood somewhere (`left`) and what stands there now
(`came`) is kept, since there neither the street nor the recorded images can be believed.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from lidarpainter_models.editing.actor_models import ActorModel, road_colour
from lidarpainter_models.editing.motions import LogTimes, standing
from lidarpainter_models.errors import ConfigError, SceneError
from lidarpainter_models.gaussians.model.gaussian_scene import GaussianScene
from lidarpainter_models.gaussians.model.placing import carried_gaussians
from lidarpainter_models.gaussians.model.styling.scene_style import LampChange
from lidarpainter_models.geometry.boxes import is_inside_box
from lidarpainter_models.geometry.driven_paths import DrivenPath
from lidarpainter_models.geometry.transforms import invert_rigid, transform_points
from lidarpainter_models.kernels.box_owners import NO_BOX, box_owners
from lidarpainter_models.lidar.actor_separation import height_above_ground
from lidarpainter_models.lidar.ground_heights import GroundHeights
from lidarpainter_models.lidar.lidar_map import LidarMap, MapPoints
from lidarpainter_models.observations.views import TrainingView
from lidarpainter_models.scenes.actor_names import named_actor, path_of_track
from lidarpainter_models.scenes.tracks import ActorTrack

PARKED_MARGIN_M = 0.15
"""Gaussians so far outside the box of a parked car are the car's."""
PARKED_CLEARANCE_M = 0.08
"""What is lower over the ground than this is road."""
GHOST_SHRINK_M = 0.2
"""So far inside the room that a car drove through, nothing stands."""
GHOST_FLOOR_M = 0.3
_GROUND_SAMPLE = 400_000


@dataclass(frozen=True, kw_only=True, eq=False)
class EditedWorld:
    """A scene, what LiDAR knows of it, and who stands in it."""

    scene: GaussianScene
    fitted: GaussianScene
    """The scene before any edit."""
    lidar_map: LidarMap
    views: tuple[TrainingView, ...]
    parked: tuple[ActorTrack, ...]
    """Annotated actors that never move and are part of the street."""
    log: LogTimes
    left: tuple[ActorTrack, ...] = ()
    """Where somebody was who is not there any more; `is_moving` as recorded."""
    came: tuple[ActorTrack, ...] = ()
    """Where somebody is who was not there."""
    lamps: tuple[LampChange, ...] = ()
    """What was switched, in order."""

    @cached_property
    def moving(self) -> tuple[ActorTrack, ...]:
        """Whoever has a body of Gaussians, in the order of the bodies."""
        return self.scene.tracks

    @property
    def tracks(self) -> tuple[ActorTrack, ...]:
        """All that can be named."""
        return (*self.moving, *self.parked)

    @cached_property
    def ground(self) -> GroundHeights:
        """The ground, from an even sample of the street."""
        xyz_m = self.lidar_map.street.measured().xyz_m
        return GroundHeights(xyz_m[:: max(1, len(xyz_m) // _GROUND_SAMPLE)])

    @cached_property
    def road_rgb(self) -> Float[Tensor, "3"] | None:
        """Colour of the road where the ego drove."""
        return road_colour(self.lidar_map, self.log.ego.world_from_body[:, :3, 3].float())

    def find(self, name: str) -> ActorTrack:
        """An actor by its id, the beginning of it, or `nearest-ahead`.

        Raises:
            SceneError: none or several are called so.
        """
        return named_actor(self.tracks, name, self.log.ego)

    def path_of(self, name: str) -> DrivenPath:
        """The way of an actor."""
        return path_of_track(self.find(name))

    def model_of(self, track: ActorTrack) -> ActorModel:
        """What an actor looks like, in its box frame.

        Raises:
            SceneError: nothing of it was fitted.
        """
        gaussians = self.scene.gaussians_at(None).select(self.rows_of(track))
        if not len(gaussians):
            raise SceneError(f"actor {track.actor_id!r} has no Gaussians here: nobody saw it")
        if self._body_of(track) is not None:
            points = self.lidar_map.actors.get(track.actor_id, MapPoints.concatenate([]))
        else:
            pose, street = invert_rigid(track.middle_pose), self.lidar_map.street
            gaussians = carried_gaussians(gaussians, pose)
            points = street.keep(self._holds(track, street.xyz_m))
            points = replace(points, xyz_m=transform_points(pose.to(points.xyz_m), points.xyz_m))
        return ActorModel(
            gaussians=gaussians.of_body(0),
            points=points.measured(),
            size_m=track.size_m,
            category=track.category,
            road_rgb=self.road_rgb,
        )

    def without(self, track: ActorTrack) -> "EditedWorld":
        """The same world once an actor has gone."""
        body = self._body_of(track)
        gone = torch.zeros(len(self.scene.gaussians), dtype=torch.bool)
        gone[self.rows_of(track)] = True
        street, actors = self.lidar_map.street, dict(self.lidar_map.actors)
        if body is None:
            street = street.keep(~self._holds(track, street.xyz_m))
        else:
            gone |= self._ghosts(track)
            actors.pop(track.actor_id, None)
        scene = self.scene.with_gaussians(self.scene.gaussians.select((~gone).nonzero()[:, 0]))
        if body is None:
            lamps = scene.blinking
            theirs = self._holds(track, lamps.centre_m) & (lamps.bodies == 0)
            scene = replace(scene, blinking=lamps.kept(~theirs))
        was_there = track if body is not None else _always(track, self.log)
        return replace(
            self,
            scene=scene if body is None else _without_body(scene, body),
            lidar_map=LidarMap(street=street, actors=actors),
            parked=tuple(one for one in self.parked if one.actor_id != track.actor_id),
            left=(*self.left, was_there),
        )

    def with_actor(self, model: ActorModel, track: ActorTrack) -> "EditedWorld":
        """The same world with somebody more, in its light and with a shadow under it.

        Raises:
            ConfigError: somebody is called so already.
        """
        if any(one.actor_id == track.actor_id for one in self.tracks):
            raise ConfigError(f"an actor {track.actor_id!r} is there already, expected a new name")
        degree = self.scene.gaussians.sh_degree
        fitting = model.exposed_like(self.road_rgb).of_degree(degree).with_shadow()
        whole = self._with_body(fitting, track)
        return replace(whole, came=(*self.came, whole.scene.actors.recorded_tracks[-1]))

    def with_recorded_actor(self, model: ActorModel, track: ActorTrack) -> "EditedWorld":
        """The same world with somebody more who was there, as the recorded images show."""
        fitting = model.exposed_like(self.road_rgb).of_degree(self.scene.gaussians.sh_degree)
        return self._with_body(fitting, track)

    def _with_body(self, model: ActorModel, track: ActorTrack) -> "EditedWorld":
        own, actors = self.scene.gaussians, self.scene.actors
        coming = model.gaussians.of_body(len(actors.recorded_tracks) + 1)
        moving = replace(track, is_moving=True, size_m=model.size_m)
        scene = replace(self.scene, gaussians=own.append(coming), actors=actors.with_rigid(moving))
        # of its own: a copy of somebody here would share tensors, which a file cannot hold twice
        its_points = model.points.keep(torch.arange(len(model.points)))
        points = {**self.lidar_map.actors, track.actor_id: its_points}
        lidar_map = LidarMap(street=self.lidar_map.street, actors=points)
        return replace(self, scene=scene, lidar_map=lidar_map)

    def rows_of(self, track: ActorTrack) -> Int[Tensor, " rows"]:
        """The Gaussians that are an actor's; of a parked car those of the street."""
        gaussians, body = self.scene.gaussians, self._body_of(track)
        if body is not None:
            return (gaussians.body_index == body).nonzero()[:, 0]
        held = self._holds(track, gaussians.means) & (gaussians.body_index == 0)
        return held.nonzero()[:, 0]

    def _body_of(self, track: ActorTrack) -> int | None:
        """Index of its body, or None where it is part of the street."""
        ids = [one.actor_id for one in self.scene.actors.recorded_tracks]
        return ids.index(track.actor_id) + 1 if track.actor_id in ids else None

    def _holds(
        self, track: ActorTrack, points_world: Float[Tensor, "points 3"]
    ) -> Bool[Tensor, " points"]:
        """Which points belong to a parked car and not to the road under it."""
        pose = track.middle_pose
        held = is_inside_box(points_world, pose, track.size_m, margin_m=PARKED_MARGIN_M)
        rows = held.nonzero()[:, 0]
        bottom_m = torch.full((len(rows),), float(pose[2, 3] - track.size_m[2] / 2))
        height_m = height_above_ground(points_world[rows], bottom_m, self.ground)
        held[rows] = height_m >= PARKED_CLEARANCE_M
        return held

    def _ghosts(self, track: ActorTrack) -> Bool[Tensor, " gaussians"]:
        """Gaussians of the street where a car drove through: smeared parts of it."""
        gaussians = self.scene.gaussians
        room_m = (track.size_m.double() - 2 * GHOST_SHRINK_M).clamp(min=0)
        poses = track.world_from_box.double()
        owners = box_owners(
            gaussians.means.detach(),
            invert_rigid(poses),
            room_m.expand(len(poses), 3),
            margin_m=0.0,
            floor_m=0.0,
        )
        is_high = gaussians.means[:, 2] > poses[0, 2, 3] - track.size_m[2] / 2 + GHOST_FLOOR_M
        return (owners != NO_BOX) & (gaussians.body_index == 0) & is_high


def _without_body(scene: GaussianScene, body: int) -> GaussianScene:
    """The scene without an actor that has no Gaussians any more."""
    own = scene.gaussians.body_index
    return replace(
        scene,
        gaussians=replace(scene.gaussians, body_index=own - (own > body).int()),
        actors=scene.actors.without(body),
        blinking=scene.blinking.without(body),
    )


def _always(track: ActorTrack, log: LogTimes) -> ActorTrack:
    """A parked car, there before it was first and after it was last seen."""
    middle_ns = int(track.timestamps_ns[len(track.timestamps_ns) // 2])
    return standing(track, middle_ns, log)


def as_moving(track: ActorTrack, log: LogTimes) -> ActorTrack:
    """The track of an actor that will be put in again: a parked car is there all the time."""
    return track if track.is_moving else replace(_always(track, log), is_moving=True)
