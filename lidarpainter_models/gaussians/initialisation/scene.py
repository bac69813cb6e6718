"""The scene a fit starts from: surfels on the LiDAR map, actors from their points, a mean sky.

Street points are kept where a training camera, or one moved aside by a few metres, can see them:
what the recorded views never show still needs geometry once the camera leaves its lane.
"""

import math
from collections.abc import Callable, Sequence
from functools import partial

import torch
from jaxtyping import Float, Int
from torch import Tensor

from lidarpainter_models.errors import ConfigError
from lidarpainter_models.gaussians.initialisation.adaptive_voxels import (
    Cloud,
    VoxelPoints,
    adaptive_voxels,
)
from lidarpainter_models.gaussians.initialisation.settings import InitialisationConfig
from lidarpainter_models.gaussians.initialisation.surfels import (
    SPACING_SIGMA,
    fill_colours,
    surfels_from_points,
    within_outlines,
)
from lidarpainter_models.gaussians.initialisation.unreached import MOST_SHARE, unreached_gaussians
from lidarpainter_models.gaussians.model.actors import Actors
from lidarpainter_models.gaussians.model.corrections import CameraCorrections, ExposureCorrections
from lidarpainter_models.gaussians.model.gaussian_scene import GaussianScene
from lidarpainter_models.gaussians.model.gaussian_set import GaussianSet
from lidarpainter_models.gaussians.model.sky import sky_from_images, sky_layout
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.geometry.transforms import transform_points
from lidarpainter_models.kernels.side_by_side import side_by_side
from lidarpainter_models.lidar.lidar_map import MapPoints
from lidarpainter_models.lidar.map_building import LEAST_WAY_M
from lidarpainter_models.observations.views import SceneObservations, TrainingView
from lidarpainter_models.scenes.categories import category_of
from lidarpainter_models.scenes.splits import rows_of_each, sampled_views
from lidarpainter_models.scenes.tracks import ActorTrack, TrackPoses

LEAST_UNSEEN_POINTS = 3
"""Voxels with fewer points that only a camera moved aside would see are dropped."""
LEAST_ACTOR_POINTS = 20
"""An actor with fewer points is not modelled."""
ACTOR_VOXEL_M = 0.05
"""Smallest voxel on an actor; its points come from the whole log."""
UNSEEN_SHARE = 0.2
"""Part of the start size for points that only a camera moved aside would see."""
BENDING = {"pedestrian", "animal", "bicycle", "motorcycle"}
"""Who is not rigid."""
LEAST_BENT_PX = 24
"""Height in an image from which somebody's steps can be seen."""
MOST_BENT_NS = 250_000_000
"""Between frames: of two steps, which take a second, four images or more are needed."""
ASIDE_M = 3.5
"""How far aside such a camera may stand."""
MOST_VIEWS_PER_CAMERA = 60
"""Views that tell where the street is seen and how finely; those between see the same, and asking
every point for every view would take the square of a log's length."""
OUTLINE_VIEWS_PER_CAMERA = 8
"""Views that tell what stands against the sky."""
MOST_STREET_POINTS, POINTS_PER_GAUSSIAN = 5_000_000, 100
"""Points of the street that are looked at, evenly, in all and for each Gaussian: the sweeps of
a car that stands are of one place."""
MOST_ACTOR_POINTS = 60_000
"""Points of an actor that are looked at: many sweeps show one side of it alike."""
POINTS_AT_ONCE = 32_768
"""Points that are asked for by one view after the other: what is kept of them fits a cache."""
_MOST_VIEWS_PER_ACTOR = 24


def initialise_scene(
    observations: SceneObservations,
    config: InitialisationConfig,
    *,
    progress: Callable[[float], None] = lambda _: None,
) -> GaussianScene:
    """Build the first scene of a fit; deterministic.

    `config.num_gaussians` must be given; `progress` is told which part of the work is done, 0 to 1,
    as far as that is known.

    Raises:
        ConfigError: no LiDAR point lies where a training camera could see it.
    """
    views = observations.views
    for_unreached = int(config.num_gaussians * MOST_SHARE)
    on_surfaces = max(config.num_gaussians - for_unreached, 1)
    gaussians = _on_surfaces(observations, config, on_surfaces, progress)
    if len(gaussians) == 0:
        raise ConfigError("no LiDAR point lies where a training camera could see it")
    progress(0.5)
    scene = _scene_around(gaussians, observations)
    seeds = unreached_gaussians(
        scene, views, budget=for_unreached, progress=lambda share: progress(0.5 + share / 2)
    )
    return scene.with_gaussians(gaussians.append(seeds))


def _scene_around(gaussians: GaussianSet, observations: SceneObservations) -> GaussianScene:
    """The Gaussians with a mean sky, and nothing corrected yet."""
    views = observations.views
    timestamps_ns = torch.tensor([view.timestamp_ns for view in views], dtype=torch.int64)
    cameras = [view.camera for view in views]
    frame_times_ns = _frame_times(views)
    exposure = _first_exposure(views, observations.camera_names)
    return GaussianScene(
        gaussians=gaussians,
        actors=Actors.uncorrected(
            observations.tracks, frame_times_ns, _bent(observations.tracks, views, frame_times_ns)
        ),
        sky=sky_from_images(
            sky_layout(cameras),
            cameras,
            # one at a time as floats
            (exposure.undone(view.rgb, view.key[1], view.timestamp_ns) for view in views),
            [view.sky_mask for view in views],
        ),
        cameras=CameraCorrections.none(
            [view.key for view in views],
            timestamps_ns,
            torch.stack([camera.world_from_camera.double() for camera in cameras]),
            observations.faults,
            observations.own_bodies,
            observations.path,
        ),
        exposure=exposure,
    )


def _first_exposure(
    views: Sequence[TrainingView], camera_names: Sequence[str]
) -> ExposureCorrections:
    """How cameras show the map's colours; one camera alone has no other to differ from."""
    names, times_ns = [view.key[1] for view in views], [view.timestamp_ns for view in views]
    if len(camera_names) == 1:
        return ExposureCorrections.none(camera_names, times_ns)
    shown = torch.tensor([view.exposure_rgb for view in views])
    return ExposureCorrections.measured(camera_names, names, times_ns, shown)


def _bent(
    tracks: Sequence[ActorTrack],
    views: Sequence[TrainingView],
    frame_times_ns: Int[Tensor, " frames"],
) -> list[int]:
    """Rows of the tracks of whoever moves within a box, where images show how."""
    if len(frame_times_ns) < 2 or int(frame_times_ns.diff().median()) > MOST_BENT_NS:
        return []
    rows = [row for row, track in enumerate(tracks) if category_of(track.category) in BENDING]
    if not rows:
        return []
    poses = TrackPoses.of([tracks[row] for row in rows])
    height_m = torch.stack([tracks[row].size_m[2] for row in rows])
    times_ns = torch.tensor([view.timestamp_ns for view in views])
    number, who = poses.present(times_ns[:, None]).nonzero().unbind(1)
    centres = poses.at(who, times_ns[number])[:, :3, 3].float()
    in_view = torch.bincount(number, minlength=len(views)).tolist()
    shown = torch.zeros(len(rows), dtype=torch.bool)
    for view, those, there in zip(views, who.split(in_view), centres.split(in_view), strict=True):
        if len(those):
            pixels_uv, depth_m = view.camera.project(there)
            is_large = view.camera.fy_px * height_m[those] >= LEAST_BENT_PX * depth_m
            shown[those] |= is_large & view.camera.contains(pixels_uv, depth_m)
    return [row for row, is_shown in zip(rows, shown.tolist(), strict=True) if is_shown]


def _frame_times(views: Sequence[TrainingView]) -> Int[Tensor, " frames"]:
    """Mean exposure time of each training frame, over its cameras."""
    of_frame: dict[int, list[int]] = {}
    for view in views:
        of_frame.setdefault(view.key[0], []).append(view.timestamp_ns)
    return torch.tensor([sum(times) // len(times) for times in of_frame.values()])


def pixel_footprint(
    xyz_m: Float[Tensor, "points 3"], cameras: Sequence[Camera], images: Sequence[int] | None = None
) -> tuple[Float[Tensor, " points"], Float[Tensor, " points"]]:
    """Size of a pixel at each point, smallest over the cameras, and how dense detail pays there.

    `images` says how many each camera has taken, by default one. A point in no image, but in that
    of a camera up to `ASIDE_M` away, has a footprint too; one beyond has an infinite one.
    Occlusion is not looked at.

    Where n Gaussians a square metre leave an image with footprint f an error of 1 / (n f^2) a
    pixel, so many of them make the error of all images least where n follows the root of the sum
    of f^-4 over the images; that root is the density, 0 for a point in no image.
    """
    parts = side_by_side(
        partial(_part_footprint, cameras=cameras, images=images or [1] * len(cameras)),
        xyz_m.split(POINTS_AT_ONCE),
    )
    footprint, density = zip(*parts, strict=True)
    return torch.cat(footprint), torch.cat(density)


def _part_footprint(
    xyz_m: Float[Tensor, "points 3"], cameras: Sequence[Camera], images: Sequence[int]
) -> tuple[Float[Tensor, " points"], Float[Tensor, " points"]]:
    """`pixel_footprint` of a few points."""
    footprint = torch.full((xyz_m.shape[0],), torch.inf)
    total = torch.zeros(xyz_m.shape[0])
    for camera, count in zip(cameras, images, strict=True):
        pixels_uv, depth_m = camera.project(xyz_m)
        is_inside = camera.contains(pixels_uv, depth_m, near_m=0.5)
        margin_px = camera.fx_px * ASIDE_M / depth_m.clamp(min=0.5)
        u, v = pixels_uv.unbind(-1)
        is_near = (u > -margin_px) & (u < camera.width_px + margin_px) & (depth_m > 0.5)
        is_near &= (v > -margin_px) & (v < camera.height_px + margin_px)
        size_m = torch.where(is_near, depth_m / camera.fx_px, torch.inf)
        total += count * torch.where(is_inside, size_m**-4, 0.0)
        footprint = torch.minimum(footprint, size_m)
    return footprint, total.sqrt()


def _spread_cameras(views: Sequence[TrainingView]) -> tuple[list[Camera], list[int]]:
    """Return a few places of each camera, evenly over the log, and the images taken there."""
    places: dict[str, list[tuple[Camera, int]]] = {}
    for view in views:
        own = places.setdefault(view.key[1], [])
        if own and float((view.camera.centre_world - own[-1][0].centre_world).norm()) < LEAST_WAY_M:
            own[-1] = (own[-1][0], own[-1][1] + 1)
        else:
            own.append((view.camera, 1))
    chosen = [
        place
        for own in places.values()
        for place in own[:: math.ceil(len(own) / MOST_VIEWS_PER_CAMERA)]
    ]
    return [camera for camera, _ in chosen], [images for _, images in chosen]


def _on_surfaces(
    observations: SceneObservations,
    config: InitialisationConfig,
    budget: int,
    progress: Callable[[float], None],
) -> GaussianSet:
    """Surfels where images show LiDAR surfaces, and some where only a moved camera would."""
    for_aside = int(budget * UNSEEN_SHARE)
    street, aside = _street(observations, config, budget, for_aside)
    progress(0.25)
    clouds = {0: street, **_actor_clouds(observations)}
    bodies, budget = list(clouds)[1:], max(budget - for_aside, 1)
    seen = adaptive_voxels(list(clouds.values()), budget=budget)
    del street, clouds  # 20 bytes a point, which nobody asks any more
    views = observations.views
    rows = rows_of_each([view.key[1] for view in views], OUTLINE_VIEWS_PER_CAMERA)
    gaussians = _surfels([seen[0], aside], [2.0, SPACING_SIGMA], config)
    gaussians = within_outlines(gaussians, [views[row] for row in rows])
    for body, voxels in zip(bodies, seen[1:], strict=True):
        gaussians = gaussians.append(_surfels([voxels], [2.0], config, body=body))
    return gaussians


def _actor_clouds(observations: SceneObservations) -> dict[int, Cloud]:
    """Points of the actors that images show, by body."""
    views, tracks = observations.views, observations.tracks
    times_ns = torch.tensor([view.timestamp_ns for view in views], dtype=torch.int64)
    is_there = TrackPoses.of(tracks).present(times_ns[:, None]).T
    clouds = {}
    for body, (track, present) in enumerate(zip(tracks, is_there, strict=True), start=1):
        if track.actor_id not in observations.lidar_map.actors:
            continue
        points = _spread(observations.lidar_map.actors[track.actor_id], MOST_ACTOR_POINTS)
        own = [views[row] for row in present.nonzero()[:, 0].tolist()]
        spacing_m = _actor_spacing(points, track, own)
        in_sight = spacing_m.isfinite()
        if int(in_sight.sum()) >= LEAST_ACTOR_POINTS:
            clouds[body] = Cloud.of(points, spacing_m, in_sight, ACTOR_VOXEL_M)
    return clouds


def _street(
    observations: SceneObservations, config: InitialisationConfig, budget: int, for_aside: int
) -> tuple[Cloud, VoxelPoints]:
    """Points that images show, and voxels of those that only a moved camera would."""
    street = observations.lidar_map.street
    street = _spread(street, min(MOST_STREET_POINTS, POINTS_PER_GAUSSIAN * budget))
    cameras, images = _spread_cameras(observations.views)
    footprint, density = pixel_footprint(street.xyz_m.contiguous(), cameras, images)
    density *= math.sqrt(len(observations.views) / sum(images))
    is_aside, least_m = (density == 0) & footprint.isfinite(), config.street_voxel_m
    (aside,) = adaptive_voxels([Cloud.of(street, footprint, is_aside, least_m)], budget=for_aside)
    # no image will ever shrink a lone blob there, and beside the lane it is large in the view
    aside = aside.keep(aside.num_points >= LEAST_UNSEEN_POINTS)
    return Cloud.of(street, density**-0.5, density > 0, least_m), aside


def _spread(points: MapPoints, most: int) -> MapPoints:
    """Return at most so many of the points, evenly over the log; nothing is copied."""
    return points.keep(slice(None, None, max(math.ceil(len(points) / most), 1)))


def _surfels(
    parts: Sequence[VoxelPoints],
    most_sigma: Sequence[float],
    config: InitialisationConfig,
    *,
    body: int = 0,
) -> GaussianSet:
    """Surfels of one body; the largest deviation of each part is in edges of its voxels."""
    xyz_m = torch.cat([part.xyz_m for part in parts])
    if len(xyz_m) == 0:
        return GaussianSet.empty(sh_degree=config.sh_degree)
    rgb = torch.cat([part.rgb for part in parts])
    has_colour = torch.cat([part.has_colour for part in parts])
    limits = zip(parts, most_sigma, strict=True)
    return surfels_from_points(
        xyz_m,
        fill_colours(xyz_m, rgb, has_colour),
        body=body,
        sh_degree=config.sh_degree,
        most_sigma_m=torch.cat([part.size_m * sigma for part, sigma in limits]),
    )


def _actor_spacing(
    points: MapPoints, track: ActorTrack, views: Sequence[TrainingView]
) -> Float[Tensor, " points"]:
    """Distance at which detail pays at each point of an actor over its time, as on the street."""
    footprint = torch.full((len(points),), torch.inf)
    total = torch.zeros(len(points))
    asked = sampled_views(views, _MOST_VIEWS_PER_ACTOR)
    xyz_box_m = points.xyz_m.contiguous()
    for view in asked:
        world_from_box = track.pose_at(view.timestamp_ns).float()
        xyz_world_m = transform_points(world_from_box, xyz_box_m)
        at_time, density = pixel_footprint(xyz_world_m, [view.camera])
        footprint = torch.minimum(footprint, at_time)
        total += len(views) / len(asked) * density.square()
    return torch.maximum(total.sqrt(), footprint**-2) ** -0.5
