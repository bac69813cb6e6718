"""Two fitted scenes of one place made one: each spot is the run's that looked at it more finely.

A run has seen a spot where one of its training views shows it: in the image, and not behind the
surface that the fit found there. How finely is metres per pixel. The rule asks for the spot and the
room around it alone, so what one run gives up the other one fills, and no surface stands twice.
"""

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from lidarpainter_models.editing.actor_models import exposed, exposure_gain, of_degree
from lidarpainter_models.editing.worlds import EditedWorld
from lidarpainter_models.errors import ConfigError, SceneError
from lidarpainter_models.gaussians.model.gaussian_set import GaussianSet
from lidarpainter_models.gaussians.model.placing import carried_gaussians
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.geometry.transforms import (
    invert_rigid,
    rotation_from_quaternion,
    transform_points,
)
from lidarpainter_models.lidar.lidar_map import LidarMap, MapPoints
from lidarpainter_models.scenes.splits import sampled_views
from lidarpainter_models.scenes.tracks import ActorTrack

FINER = 2.0
"""So many times more finely the other run must have seen what this one saw too: all else being
equal the first run stays as it is."""
BEHIND = 0.15
"""Of its depth: so far behind the surface of a pixel a spot is still shown."""
REACH = 2.0
"""Standard deviations: so far from its middle a Gaussian still shows."""
MOST_VIEWS = 120
"""Of a run, spread over its log; neighbours show the same."""
CELL_M = 0.25
"""LiDAR points so near to each other are one run's."""


@dataclass(frozen=True, kw_only=True, eq=False)
class OtherRun:
    """What is joined to a world."""

    world: EditedWorld
    """The other world, in its own frame."""
    world_from_other: Float[Tensor, "4 4"]
    is_same_drive: bool
    """Whether both saw one drive: then they have one clock, and one id is one actor."""


_Looks = list[tuple[Camera, Float[Tensor, "height width"]]]


def joined(world: EditedWorld, other: OtherRun) -> EditedWorld:
    """The world, with what the other run knows better.

    Clock, ego, views and sky stay those of the world. Of another drive the street alone is taken.

    Raises:
        ConfigError: no place was seen by both, or the other run adds nothing.
    """
    seen = _SeenTwice.of(world, other)
    if not other.is_same_drive:
        return _joined_street(world, other, seen)
    edited = {track.actor_id for track in world.left}
    drives = {track.actor_id for track in world.moving}
    theirs = other.world
    for track in theirs.parked:
        if track.actor_id in edited | drives:  # it is a body here, or was taken out
            theirs = theirs.without(track)
    whole = _joined_street(world, replace(other, world=theirs), seen)
    for track in other.world.moving:
        if track.actor_id not in edited:
            whole = _joined_actor(whole, other, track)
    return whole


def _joined_street(world: EditedWorld, other: OtherRun, seen: "_SeenTwice") -> EditedWorld:
    own, theirs = world.scene.gaussians, other.world.scene.gaussians_at(None)
    theirs = theirs.select((theirs.body_index == 0).nonzero()[:, 0])
    coming = carried_gaussians(theirs, other.world_from_other)
    enters = seen.whole_is_theirs(coming)
    if not bool(enters.any()):
        raise ConfigError("that run has seen nothing much better than this one")
    coming = coming.select(enters.nonzero()[:, 0])
    if world.road_rgb is not None and other.world.road_rgb is not None:
        coming = exposed(coming, exposure_gain(other.world.road_rgb, world.road_rgb))
    leaves = seen.whole_is_theirs(own) & (own.body_index == 0)
    drive_off = {track.actor_id for track in other.world.moving}
    for track in world.parked:
        if track.actor_id in drive_off:  # the other run saw its place without it
            leaves[world.rows_of(track)] = False
    kept = own.select((~leaves).nonzero()[:, 0])
    lamps = world.scene.blinking
    rows, lamp = lamps.inside(own.means, own.body_index, torch.arange(len(lamps)))
    stays = torch.ones(len(lamps), dtype=torch.bool)
    stays[lamp[leaves[rows]]] = False
    street, points = world.lidar_map.street, other.world.lidar_map.street
    carried_m = transform_points(other.world_from_other.to(points.xyz_m), points.xyz_m)
    points = replace(points, xyz_m=carried_m)
    both = [street.keep(~seen.are_theirs(street)), points.keep(seen.are_theirs(points))]
    known = {track.actor_id for track in world.tracks}
    stands = [_carried(track, other) for track in other.world.parked if track.actor_id not in known]
    return replace(
        world,
        scene=replace(
            world.scene,
            gaussians=kept.append(of_degree(coming, own.sh_degree)),
            blinking=lamps.kept(stays),
        ),
        lidar_map=LidarMap(street=MapPoints.concatenate(both), actors=world.lidar_map.actors),
        parked=(*world.parked, *stands),
    )


def _joined_actor(world: EditedWorld, other: OtherRun, track: ActorTrack) -> EditedWorld:
    """The world with an actor of the other run, or the same actor for longer or seen better."""
    if any(one.actor_id == track.actor_id for one in world.parked):
        return world  # it drives off later
    try:
        model = other.world.model_of(track)
    except SceneError:
        model = None  # nothing of it was fitted
    track = _carried(track, other)
    bodies = [one.actor_id for one in world.moving]
    if track.actor_id not in bodies:
        is_there = int(track.timestamps_ns[0]) <= world.log.end_ns
        is_there &= int(track.timestamps_ns[-1]) >= world.log.start_ns
        return world if model is None or not is_there else world.with_recorded_actor(model, track)
    actors, number = world.scene.actors, bodies.index(track.actor_id)
    tracks = list(actors.recorded_tracks)
    tracks[number] = _continued(tracks[number], track)
    longer = replace(actors, recorded_tracks=tuple(tracks))
    own = world.scene.gaussians
    rows = own.body_index == number + 1
    points, blinking = dict(world.lidar_map.actors), world.scene.blinking
    if model is not None and len(model.gaussians) > FINER * int(rows.sum()):
        look = model.exposed_like(world.road_rgb).of_degree(own.sh_degree)
        own = own.select((~rows).nonzero()[:, 0]).append(look.gaussians.of_body(number + 1))
        points[track.actor_id] = look.points
        longer = replace(longer, bending=longer.bending.rigid(number + 1))
        blinking = blinking.of_others(number + 1)
    return replace(
        world,
        scene=replace(world.scene, gaussians=own, actors=longer, blinking=blinking),
        lidar_map=LidarMap(street=world.lidar_map.street, actors=points),
    )


def _continued(ours: ActorTrack, theirs: ActorTrack) -> ActorTrack:
    """Our track, with the other one's boxes before its first and after its last."""
    times_ns = theirs.timestamps_ns
    before = (times_ns < ours.timestamps_ns[0]).nonzero()[:, 0]
    after = (times_ns > ours.timestamps_ns[-1]).nonzero()[:, 0]

    def both(own: Tensor, more: Tensor) -> Tensor:
        return torch.cat([more[before], own, more[after]])

    return replace(
        ours,
        frame_indices=both(ours.frame_indices, theirs.frame_indices),
        timestamps_ns=both(ours.timestamps_ns, times_ns),
        world_from_box=both(ours.world_from_box.double(), theirs.world_from_box),
        num_points=both(ours.num_points, theirs.num_points),
    )


def _carried(track: ActorTrack, other: OtherRun) -> ActorTrack:
    return replace(track, world_from_box=other.world_from_other @ track.world_from_box.double())


@dataclass(frozen=True, kw_only=True, eq=False)
class _SeenTwice:
    """How finely two runs saw places of the world of the first."""

    mine: _Looks
    theirs: _Looks
    other_from_world: Float[Tensor, "4 4"]

    @classmethod
    def of(cls, world: EditedWorld, other: OtherRun) -> "_SeenTwice":
        """Draw what both saw.

        Raises:
            ConfigError: they saw no place in common.
        """
        seen = cls(
            mine=_looks(world),
            theirs=_looks(other.world),
            other_from_world=invert_rigid(other.world_from_other),
        )
        mine_m, theirs_m = seen.finest_m(world.fitted.gaussians.means)
        if not bool((mine_m.isfinite() & theirs_m.isfinite()).any()):
            raise ConfigError("the two runs do not overlap: no place was seen by both")
        return seen

    def finest_m(
        self, places: Float[Tensor, "places 3"]
    ) -> tuple[Float[Tensor, " places"], Float[Tensor, " places"]]:
        """Metres per pixel of either run's nearest look at each place."""
        there = transform_points(self.other_from_world.to(places), places)
        return _finest_m(self.mine, places), _finest_m(self.theirs, there)

    def is_theirs(self, places: Float[Tensor, "places 3"]) -> Bool[Tensor, " places"]:
        """Whether the other run saw places so much better that they are its own."""
        mine_m, theirs_m = self.finest_m(places)
        return theirs_m * FINER < mine_m

    def whole_is_theirs(self, gaussians: GaussianSet) -> Bool[Tensor, " gaussians"]:
        """The same of Gaussians, those left out that reach into what the first run saw as well."""
        found = self.is_theirs(gaussians.means)
        rows = found.nonzero()[:, 0]
        some = gaussians.select(rows)
        axes = rotation_from_quaternion(some.rotation_wxyz) * (REACH * some.scale_m[:, None])
        axes = axes.transpose(1, 2)
        ends = some.means[:, None] + torch.cat([axes, -axes], dim=1)  # where they fade out
        mine_m, theirs_m = self.finest_m(ends.flatten(0, 1))
        is_mine = mine_m.isfinite() & (mine_m <= theirs_m * FINER)
        found[rows] = ~is_mine.unflatten(0, (len(rows), 6)).any(dim=1)
        return found

    def are_theirs(self, points: MapPoints) -> Bool[Tensor, " points"]:
        """The same of LiDAR points, asked for one of each cell."""
        cells, cell_of = (points.xyz_m / CELL_M).floor().int().unique(dim=0, return_inverse=True)
        one_of = torch.zeros(len(cells), dtype=torch.int64)
        one_of[cell_of] = torch.arange(len(points))
        return self.is_theirs(points.xyz_m[one_of])[cell_of]


def _looks(world: EditedWorld) -> _Looks:
    """Training views where the fit found them, and the surfaces that they show."""
    looks = []
    for view in sampled_views(world.views, MOST_VIEWS):
        camera = world.fitted.refined_camera(view)
        looks.append((camera, world.fitted.render(camera, view.timestamp_ns).depth_m))
    return looks


def _finest_m(looks: _Looks, places: Float[Tensor, "places 3"]) -> Float[Tensor, " places"]:
    """Metres per pixel of the nearest look at each place; infinite where none shows it."""
    found = torch.full((len(places),), math.inf)
    for camera, surface_m in looks:
        pixels_uv, depth_m = camera.project(places)
        inside = camera.contains(pixels_uv, depth_m).nonzero()[:, 0]
        column, row = pixels_uv[inside].long().unbind(1)
        before_m = surface_m[row, column]
        shows = (before_m == 0) | (depth_m[inside] <= before_m * (1 + BEHIND))
        rows = inside[shows]
        found[rows] = torch.minimum(found[rows], depth_m[rows] / camera.fx_px)
    return found
