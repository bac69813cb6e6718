"""See every actor of a scene in every view: what `Sighting` collects, for all at once."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from lidarpainter_models.assets.seen_surfaces import SeenSurface
from lidarpainter_models.assets.sightings import BoxView, Sighting, box_view
from lidarpainter_models.editing.worlds import EditedWorld, as_moving
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.metrics.images import squared_error
from lidarpainter_models.scenes.tracks import ActorTrack, TrackPoses

FARTHEST_M = 80.0
"""Who is farther away shows nothing that is worth keeping."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ShownImage:
    """What a camera showed, in the colours of the scene itself."""

    rgb: Float[Tensor, "height width 3"]
    shows_surface: Bool[Tensor, "height width"]
    """Where that is neither sky nor the recording car."""


@dataclass(frozen=True, kw_only=True, eq=False)
class RecordedLook:
    """A recorded image, and what it is good for."""

    camera: Camera
    """At its refined pose, at fit size."""
    camera_name: str
    timestamp_ns: int
    is_seen: bool
    """Whether the fit saw it: then it tells from where actors were seen."""
    truth_rgb: Callable[[], Float[Tensor, "height width 3"]] | None
    """The image, where the fit is held against it."""
    shown: Callable[[], ShownImage] | None = None
    """The image, where it tells how actors look."""


def sighted_actors(
    world: EditedWorld,
    looks: Sequence[RecordedLook],
    progress: Callable[[int, int], None],
    surfaces: Mapping[str, SeenSurface] | None = None,
) -> dict[str, Sighting]:
    """What the images of a run show of each of its actors, parked ones too, by id.

    The surfaces of those that have one, by id, take the colours that the images show of them.
    """
    tracks = [as_moving(track, world.log) for track in world.tracks]
    poses = TrackPoses.of(tracks)
    found: dict[str, Sighting] = {track.actor_id: Sighting() for track in tracks}
    for done, look in enumerate(looks, start=1):
        _add(world, look, tracks, poses, found, surfaces or {})
        progress(done, len(looks))
    return found


def _add(
    world: EditedWorld,
    look: RecordedLook,
    tracks: Sequence[ActorTrack],
    poses: TrackPoses,
    found: dict[str, Sighting],
    surfaces: Mapping[str, SeenSurface],
) -> None:
    """Take one view of all who are there."""
    here = poses.all_at(look.timestamp_ns)
    is_near = _may_be_seen(look.camera, here[:, :3, 3], [track.size_m for track in tracks])
    rows = (is_near & poses.present(look.timestamp_ns)).nonzero()[:, 0].tolist()
    if not rows:
        return
    drawn = world.fitted.render(look.camera, look.timestamp_ns, camera_name=look.camera_name)
    depth_m, rgb = drawn.depth_m.cpu(), drawn.rgb.cpu().clamp(0, 1)
    maps = None
    if look.truth_rgb is not None:
        truth = look.truth_rgb()
        maps = (squared_error(rgb, truth), _gradient(rgb), _gradient(truth))
    views = [box_view(look.camera, depth_m, here[row], tracks[row].size_m) for row in rows]
    both = [(row, seen) for row, seen in zip(rows, views, strict=True) if seen is not None]
    for row, seen in both:
        sighting = found[tracks[row].actor_id]
        if look.is_seen:
            sighting.add_look(seen, look.camera.fx_px)
        if maps is not None:
            sighting.add_error(seen, *maps)
    own = [(surfaces.get(tracks[row].actor_id), here[row], seen) for row, seen in both]
    if look.shown is not None and any(surface is not None for surface, _, _ in own):
        _add_colours(look, look.shown(), depth_m, own)


def _add_colours(
    look: RecordedLook,
    shown: ShownImage,
    depth_m: Float[Tensor, "height width"],
    seen: Sequence[tuple[SeenSurface | None, Float[Tensor, "4 4"], BoxView]],
) -> None:
    """What one image shows of surfaces, the nearest first: pixels of its box show no other one."""
    is_free = shown.shows_surface.clone()
    for surface, world_from_box, view in sorted(
        seen, key=lambda one: float(one[2].camera_box.norm())
    ):
        if surface is not None:
            surface.add_look(
                look.camera,
                world_from_box,
                rgb=shown.rgb,
                depth_m=depth_m,
                shows_surface=is_free,
            )
        is_free[view.row, view.column] = False


def _may_be_seen(
    camera: Camera, centres_world: Float[Tensor, "actors 3"], sizes_m: Sequence[Tensor]
) -> Tensor:
    """Leave out who is far away, behind the camera, or far outside the image."""
    if not len(sizes_m):
        return torch.zeros(0, dtype=torch.bool)
    reach_m = torch.stack(list(sizes_m)).double().norm(dim=1) / 2
    pixels_uv, depth_m = camera.project(centres_world.double())
    reach_px = reach_m / depth_m.clamp(min=1.0) * max(camera.fx_px, camera.fy_px)
    size_px = torch.tensor([camera.width_px, camera.height_px])
    outside_px = torch.maximum(-pixels_uv, pixels_uv - size_px).amax(1)
    is_ahead = (depth_m > -reach_m) & (depth_m < FARTHEST_M)
    return is_ahead & ((outside_px < 2 * reach_px) | (depth_m < 2 * reach_m))


def _gradient(rgb: Float[Tensor, "height width 3"]) -> Float[Tensor, "height width"]:
    """How much the brightness changes from a pixel to the ones right of it and below."""
    grey = rgb.mean(dim=2)
    across = torch.diff(grey, dim=1, append=grey[:, -1:])
    down = torch.diff(grey, dim=0, append=grey[-1:])
    return torch.hypot(across, down)
