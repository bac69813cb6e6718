"""What clients change in a served scene: others in the place of actors, and actors that come.

Who comes is an asset of a library, named or the one nearest in class and size. Poses of clients are
the middles of the boxes that they have in mind: an asset of another height stands on the bottom of
that box. What was changed holds for everybody, until a client takes it back.
World: x forward, y left, z up; metres.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from threading import RLock
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from lidarpainter_models.editing.actor_models import ActorModel
from lidarpainter_models.editing.ground_filling import fill_ground
from lidarpainter_models.editing.motions import LogTimes
from lidarpainter_models.editing.worlds import EditedWorld, as_moving
from lidarpainter_models.errors import SceneError
from lidarpainter_models.scenes.driving_scene import driven_road
from lidarpainter_models.scenes.tracks import ActorTrack
from lidarpainter_models.serving.messages import TimedRequest, middle_of, track_poses
from lidarpainter_models.serving.protos import Message
from lidarpainter_models.serving.refusals import RequestError, invalid
from lidarpainter_models.serving.renderer import ServedScene

MOST_COME = 64
"""Actors that come into one scene: each takes memory."""
LEAST_M, MOST_M = 0.05, 50.0
"""Of a side of an actor that is told."""
USUAL = "car"
"""Who stands for somebody whose name tells no class."""


@runtime_checkable
class AssetLibrary(Protocol):
    """Actors of elsewhere."""

    @property
    def names(self) -> Sequence[str]:
        """Of all of them."""
        ...

    @property
    def categories(self) -> Sequence[str]:
        """Classes of which there are any, as the data sets call them."""
        ...

    def model(self, name: str) -> ActorModel:
        """What one looks like.

        Raises:
            RequestError: INVALID_ARGUMENT: there is none of that name.
        """
        ...

    def nearest(self, category: str, size_m: Float[Tensor, "3"] | None) -> str:
        """The one that is nearest in class and size; of usual size where none is told.

        Raises:
            RequestError: INVALID_ARGUMENT: there is nobody at all.
        """
        ...


@dataclass(eq=False, kw_only=True)
class SceneEdits:
    """A scene as it was fitted, and as its clients have it by now."""

    fitted: ServedScene
    library: AssetLibrary
    has_placeholders: bool = False
    """Whether somebody of the library stands for an actor that the scene does not have."""
    num_changes: int = field(default=0, init=False)
    _lock: RLock = field(default_factory=RLock, init=False)

    def __post_init__(self) -> None:
        """Nothing is changed yet."""
        self._shown, self._world = self.fitted, world_of(self.fitted)

    @property
    def is_edited(self) -> bool:
        """Whether anything was changed that still holds."""
        return self._shown is not self.fitted

    def shown(self, request: TimedRequest | None = None) -> ServedScene:
        """The scene as it is by now, and with placeholders for who else is in a request.

        Raises:
            RequestError: RESOURCE_EXHAUSTED: too many have come; INVALID_ARGUMENT: nobody is there
                to stand for a stranger.
        """
        with self._lock:
            known = {track.actor_id for track in self._world.tracks}
            ids = () if request is None or not self.has_placeholders else request.actor_ids
            strangers = [place for place, name in enumerate(ids) if name not in known]
            if request is not None and strangers:
                world, middles = self._world, middle_of(request.world_from_actors)
                times_ns = torch.tensor([request.middle_ns])
                for place in strangers:
                    words = ids[place].lower()
                    named = [one for one in self.library.categories if one.lower() in words]
                    model = self.library.model(self.library.nearest((*named, USUAL)[0], None))
                    track = model.driving(ids[place], times_ns, middles[place : place + 1])
                    world = self._come(world, model, track)
                self._show(world)
            return self._shown

    def edit(self, message: Message) -> None:
        """Do all that an `EditAssetsRequest` asks for, or nothing.

        Raises:
            RequestError: INVALID_ARGUMENT: no such actor or asset, or a way that is none;
                RESOURCE_EXHAUSTED: too many have come.
        """
        with self._lock:
            world = self._world
            for one in message.replace:
                world = self._replaced(world, one)
            for one in message.insert:
                size_m = _size(one.object_size, f"actor {one.id!r}")
                model = self._model(world, one.asset_id, one.semantic_class or USUAL, size_m)
                track = model.driving(one.id, *track_poses(one.trajectory, f"actor {one.id!r}"))
                world = self._come(world, _on_bottom_of(model, size_m), track)
            self._show(world)

    def restore(self) -> None:
        """Take back all changes."""
        with self._lock:
            if self.is_edited:
                self._shown, self._world = self.fitted, world_of(self.fitted)
                self.num_changes += 1

    def _show(self, world: EditedWorld) -> None:
        self._world, self._shown = world, self.fitted.showing(world.scene)
        self.num_changes += 1

    def _come(self, world: EditedWorld, model: ActorModel, track: ActorTrack) -> EditedWorld:
        """The world with somebody more."""
        if self.fitted.scene.style is not None:
            raise RequestError("FAILED_PRECONDITION", "nobody is put into a scene in a style")
        if len(world.came) >= MOST_COME:
            raise RequestError(
                "RESOURCE_EXHAUSTED", f"{MOST_COME} actors came already: expected no more"
            )
        if not track.actor_id or any(one.actor_id == track.actor_id for one in world.tracks):
            raise invalid(f"actor {track.actor_id!r} is there already, expected a new name")
        return world.with_actor(model, track)

    def _replaced(self, world: EditedWorld, action: Message) -> EditedWorld:
        """The world with an asset in the place of an actor."""
        name = action.original_id
        track = next((one for one in world.tracks if one.actor_id == name), None)
        if track is None:
            raise invalid(f"original_id {name!r}: the scene has no such actor")
        told_m = _size(action.object_size, f"actor {name!r}")
        wanted_m = track.size_m if told_m is None else told_m
        model = self._model(world, action.replacement_id, track.category, wanted_m)
        moving = replace(as_moving(track, world.log), size_m=model.size_m)
        return self._come(world.without(track), _on_bottom_of(model, track.size_m), moving)

    def _model(
        self, world: EditedWorld, name: str, category: str, size_m: Float[Tensor, "3"] | None
    ) -> ActorModel:
        """An asset by its name, a copy of an actor of the scene, or else the nearest asset."""
        own = next((one for one in world.tracks if name and one.actor_id == name), None)
        if own is None:
            return self.library.model(name or self.library.nearest(category, size_m))
        try:
            return world.model_of(own)
        except SceneError as error:  # nobody saw it
            raise invalid(str(error)) from None


def world_of(served: ServedScene) -> EditedWorld:
    """A served scene, ready to be edited."""
    builder = served.builder
    recorded = served.recorded.corrected(served.scene.cameras.path)
    return EditedWorld(
        scene=served.scene,
        fitted=served.scene,
        lidar_map=builder.lidar_map,
        views=builder.training_views,
        parked=tuple(served.parked.tracks.values()),
        log=LogTimes(ego=driven_road(recorded)),
    )


def with_parked_apart(served: ServedScene) -> ServedScene:
    """A scene whose parked actors are no part of the street: they may be moved and left out.

    The road under them is continued from what lies around; what else they hid is open.
    """
    world = world_of(served)
    for track in world.parked:
        try:
            model = world.model_of(track)
        except SceneError:  # nobody saw it
            continue
        moving = as_moving(track, world.log)
        world = world.without(track).with_recorded_actor(model, moving)
    street, ground = world.lidar_map.street, world.ground
    scene, road = fill_ground(world.scene, street, ground, world.left)
    return served.showing(road.added_to(scene))


def _size(box: Message, what: str) -> Float[Tensor, "3"] | None:
    """Length, width and height that a message tells; None where it tells none."""
    size_m = (box.size_x, box.size_y, box.size_z)
    if not any(size_m):
        return None
    if not all(LEAST_M <= side <= MOST_M for side in size_m):
        raise invalid(
            f"{what}: object_size {', '.join(f'{side:g}' for side in size_m)}: expected "
            f"{LEAST_M:g} to {MOST_M:g} m"
        )
    return torch.tensor(size_m)


def _on_bottom_of(model: ActorModel, size_m: Float[Tensor, "3"] | None) -> ActorModel:
    """A model whose wheels stand on the bottom of another box about the same middle."""
    if size_m is None:
        return model
    shift_m = torch.stack([*torch.zeros(2), (model.size_m[2] - size_m[2]) / 2])
    return replace(
        model,
        gaussians=replace(model.gaussians, means=model.gaussians.means + shift_m),
        points=replace(model.points, xyz_m=model.points.xyz_m + shift_m),
        size_m=torch.stack([*model.size_m[:2], size_m[2]]),
    )
