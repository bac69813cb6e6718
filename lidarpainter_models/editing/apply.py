"""Apply the operations of an edit script to a scene, one after the other: move, add, take out."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import torch

from lidarpainter_models.editing.actor_models import ActorModel
from lidarpainter_models.editing.motions import (
    LogTimes,
    beside_ego,
    continued,
    rerouted,
    retimed,
    standing,
    stopped,
    with_poses,
    within,
)
from lidarpainter_models.editing.scene_merging import OtherRun, joined
from lidarpainter_models.editing.script import (
    ActorSource,
    Crop,
    Drive,
    Freeze,
    Insert,
    Join,
    Lamps,
    Move,
    Operation,
    Remove,
    Retime,
    Scale,
    Stop,
    Style,
    Swap,
)
from lidarpainter_models.editing.worlds import EditedWorld, as_moving
from lidarpainter_models.errors import ConfigError
from lidarpainter_models.gaussians.model.styling.scene_style import LampChange
from lidarpainter_models.geometry.trajectory_specs import parse_trajectory
from lidarpainter_models.lidar.collisions import Collision, MovingBody, find_collisions
from lidarpainter_models.lidar.lidar_map import LidarMap
from lidarpainter_models.scenes.tracks import ActorTrack, TrackPoses

Models = Mapping[ActorSource, ActorModel]
"""What actors of other runs and of files look like."""
Others = Mapping[Join, OtherRun]
"""What is joined."""
CROP_MARGIN_M = 30.0
"""So far to the side of the path a cropped street goes on."""


@dataclass(frozen=True, kw_only=True)
class Encounter:
    """What an actor that was moved or put in runs into."""

    actor_id: str
    collision: Collision

    def __str__(self) -> str:
        return f"{self.actor_id} meets {self.collision}"


def edited(
    world: EditedWorld, operations: Sequence[Operation], models: Models, others: Others
) -> EditedWorld:
    """The world after all operations.

    Raises:
        ConfigError: an operation cannot be done; it is named.
        SceneError: an actor is not there.
    """
    for number, operation in enumerate(operations, start=1):
        try:
            world = _edited_once(world, operation, models, others)
        except ValueError as error:  # the errors of a scene and of settings are such
            raise ConfigError(f"operation {number}, {operation.op}: {error}") from None
    return world


def encounters(world: EditedWorld) -> list[Encounter]:
    """What those who came run into: points of the street, boxes of others."""
    here = {track.actor_id: track for track in world.moving}
    found = []
    for track in (here[one.actor_id] for one in world.came if one.actor_id in here):
        others = [other for other in world.tracks if other.actor_id != track.actor_id]
        hits = find_collisions(
            MovingBody.car(within(track, world.log)),
            world.lidar_map.street,
            others,
            start_ns=world.log.start_ns,
        )
        found += [Encounter(actor_id=track.actor_id, collision=hit) for hit in hits]
    return found


def refuse_walls(found: Sequence[Encounter]) -> None:
    """Refuse actors in a wall.

    Raises:
        ConfigError: somebody runs into points of the street.
    """
    if walls := [one for one in found if one.collision.is_wall]:
        raise ConfigError(f"a path into a wall: {walls[0]}; --allow-collisions goes through")


def _edited_once(
    world: EditedWorld, operation: Operation, models: Models, others: Others
) -> EditedWorld:
    if isinstance(operation, Drive | Style):  # a style is put on last, over what was mended
        return world
    if isinstance(operation, Join):
        return joined(world, others[operation])
    if isinstance(operation, Crop):
        return _cropped(world, operation)
    if isinstance(operation, Insert):
        return _inserted(world, operation, _model(world, operation.source, models))
    if isinstance(operation, Freeze):
        return _frozen(world, operation)
    if isinstance(operation, Lamps):
        return _switched(world, operation)
    if isinstance(operation, Remove):
        return _removed(world, operation)
    return _put_elsewhere(world, operation, models)


def _put_elsewhere(
    world: EditedWorld, operation: Move | Swap | Scale | Retime | Stop, models: Models
) -> EditedWorld:
    """Take an actor out and put it, or another in its place, in again."""
    track = world.find(operation.actor)
    moving = as_moving(track, world.log)
    if isinstance(operation, Swap):
        model = _model(world, operation.source, models)
    else:
        model = world.model_of(track)
    if isinstance(operation, Scale):
        model = model.scaled(operation.factor)
    if isinstance(operation, Swap | Scale):
        moving = _on_bottom(moving, model)
    else:
        moving = _otherwise(world, moving, operation)
    return world.without(track).with_actor(model, moving)


def _otherwise(
    world: EditedWorld, track: ActorTrack, operation: Move | Retime | Stop
) -> ActorTrack:
    """An actor on another way."""
    log = world.log
    if isinstance(operation, Move):
        way = parse_trajectory(operation.trajectory, max_shift_m=None)
        if len(track.timestamps_ns) < len(log.ego):  # who stands has two times: none to move in
            track = _at_every_frame(track, log)
        return rerouted(track, way, log, world.ground, world.path_of)
    if isinstance(operation, Retime):
        return retimed(track, log, delay_s=operation.delay_s, speed=operation.speed)
    return stopped(track, log.time_ns(operation.at_s, "at_s"), log, over_s=operation.over_s)


def _at_every_frame(track: ActorTrack, log: LogTimes) -> ActorTrack:
    """The same way, with a pose at every frame of the log at which it is there."""
    frames_ns = log.ego.timestamps_ns
    inside = TrackPoses.of([track]).present(frames_ns[:, None], 0)[:, 0]
    times_ns = torch.cat([track.timestamps_ns, frames_ns[inside]]).unique()
    poses = torch.stack([track.pose_at(time) for time in times_ns.tolist()])
    before = torch.searchsorted(track.timestamps_ns, times_ns, right=True) - 1
    # with the frame of the box before each, it is away where it was
    return replace(with_poses(track, times_ns, poses), frame_indices=track.frame_indices[before])


def _inserted(world: EditedWorld, operation: Insert, model: ActorModel) -> EditedWorld:
    times_ns, poses = beside_ego(
        world.log,
        world.ground,
        ahead_m=operation.ahead_m,
        left_m=operation.left_m,
        yaw_rad=math.radians(operation.yaw_deg),
        speed_mps=operation.speed_mps,
        size_m=model.size_m,
    )
    track = model.driving(operation.name, times_ns, poses)
    way = parse_trajectory(operation.trajectory, max_shift_m=None)
    if not way.is_recorded:
        track = rerouted(track, way, world.log, world.ground, world.path_of)
    return world.with_actor(model, continued(track, world.log, world.ground))


def _removed(world: EditedWorld, operation: Remove) -> EditedWorld:
    for name in operation.actors:
        world = world.without(world.find(name))
    return world


def _switched(world: EditedWorld, operation: Lamps) -> EditedWorld:
    """The world with an actor's lamps switched; a parked car gets a body, and so lamps."""
    track, log = world.find(operation.actor), world.log
    before_ns, after_ns = log.around_ns
    first_ns, last_ns = before_ns, after_ns
    if operation.from_s > 0:
        first_ns = log.time_ns(operation.from_s, "from_s")
    if operation.until_s is not None:
        last_ns = log.time_ns(operation.until_s, "until_s")
    change = LampChange(
        actor_id=track.actor_id, state=operation.state, first_ns=first_ns, last_ns=last_ns
    )
    if change.first_ns > change.last_ns:
        raise ConfigError("expected from_s <= until_s")
    changes = [change]
    if track in world.parked:
        dark = replace(change, state="off", first_ns=before_ns, last_ns=after_ns)
        model = world.model_of(track)
        world = world.without(track).with_recorded_actor(model, as_moving(track, log))
        changes = [dark, change]
    return replace(world, lamps=(*world.lamps, *changes))


def _frozen(world: EditedWorld, operation: Freeze) -> EditedWorld:
    at_ns = world.log.time_ns(operation.at_s, "at_s")
    for track in world.moving:
        is_there = track.is_present(at_ns)
        try:
            model = world.model_of(track)
        except ValueError:
            continue  # nobody saw it: there is nothing to be frozen
        world = world.without(track)
        if is_there:
            world = world.with_actor(model, standing(track, at_ns, world.log))
    return world


def _cropped(world: EditedWorld, operation: Crop) -> EditedWorld:
    """Keep what stands beside a stretch of the ego's path, and whoever drives."""
    ego = world.log.ego
    steps_m = torch.linspace(operation.from_m, operation.to_m, 200, dtype=torch.float64)
    rows = torch.zeros(200, dtype=torch.int64)
    middle = (ego.moved_along(rows, steps_m) @ ego.world_from_body[rows])[:, :2, 3].float()

    def is_kept(xyz_m: torch.Tensor) -> torch.Tensor:
        kept = torch.zeros(len(xyz_m), dtype=torch.bool)
        low, high = middle.amin(0) - CROP_MARGIN_M, middle.amax(0) + CROP_MARGIN_M
        near = ((xyz_m[:, :2] >= low) & (xyz_m[:, :2] <= high)).all(dim=1).nonzero()[:, 0]
        for some in near.split(50_000):
            distance_m, nearest = torch.cdist(xyz_m[some, :2], middle).min(dim=1)
            is_end = (nearest == 0) | (nearest == len(middle) - 1)
            kept[some] = (distance_m <= CROP_MARGIN_M) & ~is_end
        return kept

    scene, street = world.scene, world.lidar_map.street
    gaussians = scene.gaussians
    kept = is_kept(gaussians.means) | (gaussians.body_index > 0)
    if not bool((kept & (gaussians.body_index == 0)).any()):
        raise ConfigError(f"nothing stands from {operation.from_m:g} to {operation.to_m:g} m")
    street = street.keep(is_kept(street.xyz_m))
    return replace(
        world,
        scene=scene.with_gaussians(gaussians.select(kept.nonzero()[:, 0])),
        lidar_map=LidarMap(street=street, actors=world.lidar_map.actors),
        parked=tuple(
            track
            for track in world.parked
            if bool(is_kept(track.world_from_box[:1, :3, 3].float()))
        ),
    )


def _model(world: EditedWorld, source: ActorSource, models: Models) -> ActorModel:
    if source.actor is not None and source.run is None:
        return world.model_of(world.find(source.actor))
    return models[source]


def _on_bottom(track: ActorTrack, model: ActorModel) -> ActorTrack:
    """A track for somebody of another height: the bottom of the box stays where it is."""
    poses = track.world_from_box.double().clone()
    poses[:, :3, 3] += (model.size_m[2] - track.size_m[2]).double() / 2 * poses[:, :3, 2]
    return replace(track, world_from_box=poses, size_m=model.size_m)
