"""The scene a fit starts from: surfels on the LiDAR map, actors from their points, a mean sky.

Street points are kept where a training camera, or one moved aside by a few metres, can see them:
what the recorded views never show still needs geometry once the camera leaves its lane.
"""

import math
from collections.abc import Callable, Sequence

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from lidarpainter_models.errors import ConfigError
from lidarpainter_models.gaussians.initialisation.adaptive_voxels import (
    VoxelPoints,
    adaptive_voxels,
)
from lidarpainter_models.gaussians.initialisation.settings import InitialisationConfig
from lidarpainter_models.gaussians.initialisation.surfels import (
    SPACING_SIGMA,
    fill_colours,
    surfels_from_points,
)
from lidarpainter_models.gaussians.initialisation.unreached import (
    MOST_SHARE,
    unreached_gaussians,
)
from lidarpainter_models.gaussians.model.actors import Actors
from lidarpainter_models.gaussians.model.corrections import CameraCorrections, ExposureCorrections
from lidarpainter_models.gaussians.model.gaussian_scene import GaussianScene
from lidarpainter_models.gaussians.model.gaussian_set import GaussianSet
from lidarpainter_models.gaussians.model.sky import sky_from_images, sky_layout
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.geometry.transforms import transform_points
from lidarpainter_models.lidar.lidar_map import MapPoints
from lidarpainter_models.observations.views import SceneObservations, TrainingView
from lidarpainter_models.scenes.driving_scene import ActorTrack

LEAST_UNSEEN_POINTS = 3
"""Voxels with fewer points that only a camera moved aside would see are dropped."""
LEAST_ACTOR_POINTS = 20
"""An actor with fewer points is not modelled."""
ACTOR_VOXEL_M = 0.05
"""Smallest voxel on an actor; its points come from the whole log."""
MOST_ACTOR_SHARE = 0.4  # actors get at most this part of the start size
UNSEEN_SHARE = 0.2
"""Part of the street's share for points that only a camera moved aside would see."""
MOST_VIEWS_PER_CAMERA = 60
"""Views that tell where the street is seen and how finely; those between see the same, and asking
every point for every view would take the square of a log's length."""
MOST_STREET_POINTS = 5_000_000
"""Of the street's points so many are looked at, evenly: dozens for each Gaussian."""
_MOST_VIEWS_PER_ACTOR = 24
_APART_M = 64.0  # longer than any vehicle, short enough for float32 to stay exact


def initialise_scene(
    observations: SceneObservations,
    config: InitialisationConfig,
    *,
    progress: Callable[[float], None] = lambda _: None,
) -> GaussianScene:
    """Build the first scene of a fit; deterministic.

    Args:
        observations: what was recorded.
        config: see there.
        progress: told which part of the work is done, 0 to 1, as far as that is known.

    Raises:
        ConfigError: no LiDAR point lies where a training camera could see it.
    """
    views = observations.views
    actors = _actor_gaussians(observations, config)
    progress(0.25)
    for_unreached = int(config.num_gaussians * MOST_SHARE)
    for_street = config.num_gaussians - for_unreached - sum(len(part) for part in actors)
    gaussians = _street_gaussians(observations.lidar_map.street, views, config, max(for_street, 1))
    for part in actors:
        gaussians = gaussians.append(part)
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
    return GaussianScene(
        gaussians=gaussians,
        actors=Actors.uncorrected(observations.tracks, _frame_times(views)),
        sky=sky_from_images(
            sky_layout(cameras),
            cameras,
            (view.rgb for view in views),  # one at a time as floats
            [view.sky_mask for view in views],
        ),
        cameras=CameraCorrections.none(
            [view.key for view in views],
            timestamps_ns,
            torch.stack([camera.world_from_camera.double() for camera in cameras]),
            observations.faults,
        ),
        exposure=ExposureCorrections.none(
            observations.camera_names, [view.timestamp_ns for view in views]
        ),
    )


def _frame_times(views: Sequence[TrainingView]) -> Int[Tensor, " frames"]:
    """Mean exposure time of each training frame, over its cameras."""
    of_frame: dict[int, list[int]] = {}
    for view in views:
        of_frame.setdefault(view.key[0], []).append(view.timestamp_ns)
    return torch.tensor([sum(times) // len(times) for times in of_frame.values()])


def pixel_footprint(
    xyz_m: Float[Tensor, "points 3"], cameras: Sequence[Camera], *, aside_m: float
) -> tuple[Float[Tensor, " points"], Bool[Tensor, " points"]]:
    """Size of a pixel at each point (smallest over the cameras), and whether it is in an image.

    A point in no image, but in that of a camera up to `aside_m` away, counts too; one beyond has
    an infinite footprint. Occlusion is not looked at.
    """
    footprint = torch.full((xyz_m.shape[0],), torch.inf)
    in_image = torch.zeros(xyz_m.shape[0], dtype=torch.bool)
    for camera in cameras:
        pixels_uv, depth_m = camera.project(xyz_m)
        in_image |= camera.contains(pixels_uv, depth_m, near_m=0.5)
        margin_px = camera.fx_px * aside_m / depth_m.clamp(min=0.5)
        u, v = pixels_uv.unbind(-1)
        is_near = (u > -margin_px) & (u < camera.width_px + margin_px) & (depth_m > 0.5)
        is_near &= (v > -margin_px) & (v < camera.height_px + margin_px)
        size_m = torch.where(is_near, depth_m / camera.fx_px, torch.inf)
        footprint = torch.minimum(footprint, size_m)
    return footprint, in_image


def _street_gaussians(
    points: MapPoints, views: Sequence[TrainingView], config: InitialisationConfig, budget: int
) -> GaussianSet:
    """Surfels on the street: most where images show it, some where only a moved camera would."""
    points = points.keep(torch.arange(0, len(points), math.ceil(len(points) / MOST_STREET_POINTS)))
    footprint, in_image = pixel_footprint(
        points.xyz_m, _spread_cameras(views), aside_m=config.aside_m
    )
    is_aside = ~in_image & footprint.isfinite()
    for_aside = int(budget * UNSEEN_SHARE)
    seen = _street_voxels(points, footprint, in_image, config, max(budget - for_aside, 1))
    aside = _street_voxels(points, footprint, is_aside, config, max(for_aside, 1))
    # no image will ever shrink a lone blob there, and beside the lane it is large in the view
    aside = aside.keep(aside.num_points >= LEAST_UNSEEN_POINTS)
    xyz_m = torch.cat([seen.xyz_m, aside.xyz_m])
    if xyz_m.shape[0] == 0:
        return GaussianSet.empty(sh_degree=config.sh_degree)
    rgb = torch.cat([seen.rgb, aside.rgb])
    return surfels_from_points(
        xyz_m,
        fill_colours(xyz_m, rgb, torch.cat([seen.has_colour, aside.has_colour])),
        sh_degree=config.sh_degree,
        most_sigma_m=torch.cat([2 * seen.size_m, SPACING_SIGMA * aside.size_m]),
    )


def _spread_cameras(views: Sequence[TrainingView]) -> list[Camera]:
    """At most so many views of each camera, evenly over the log."""
    cameras: dict[str, list[Camera]] = {}
    for view in views:
        cameras.setdefault(view.key[1], []).append(view.camera)
    return [
        camera
        for own in cameras.values()
        for camera in own[:: math.ceil(len(own) / MOST_VIEWS_PER_CAMERA)]
    ]


def _street_voxels(
    points: MapPoints,
    footprint: Float[Tensor, " points"],
    chosen: Bool[Tensor, " points"],
    config: InitialisationConfig,
    budget: int,
) -> VoxelPoints:
    """The chosen points, thinned out to a budget."""
    return adaptive_voxels(
        points.xyz_m[chosen],
        points.rgb_u8[chosen].float() / 255,
        points.has_colour[chosen],
        footprint[chosen],
        budget=budget,
        least_m=config.street_voxel_m,
    )


def _actor_gaussians(
    observations: SceneObservations, config: InitialisationConfig
) -> list[GaussianSet]:
    """Surfels of every actor with enough points in sight, at most the actors' share."""
    clouds = []
    for index, track in enumerate(observations.tracks):
        points = observations.lidar_map.actors.get(track.actor_id)
        if points is None:
            continue
        footprint = _actor_footprint(points, track, observations.views, config)
        in_sight = footprint.isfinite()
        if int(in_sight.sum()) >= LEAST_ACTOR_POINTS:
            clouds.append((index + 1, points.keep(in_sight), footprint[in_sight]))
    if not clouds:
        return []
    body = torch.cat([torch.full((len(part),), index) for index, part, _ in clouds])
    # one search over all actors: their boxes are set far apart so that no voxel is shared
    apart_m = body.float()[:, None] * torch.tensor([_APART_M, 0.0, 0.0])
    voxels = adaptive_voxels(
        torch.cat([part.xyz_m for _, part, _ in clouds]) + apart_m,
        torch.cat([part.rgb_u8 for _, part, _ in clouds]).float() / 255,
        torch.cat([part.has_colour for _, part, _ in clouds]),
        torch.cat([footprint for _, _, footprint in clouds]),
        budget=max(int(config.num_gaussians * MOST_ACTOR_SHARE), 1),
        least_m=ACTOR_VOXEL_M,
    )
    owner = torch.round(voxels.xyz_m[:, 0] / _APART_M).long()
    parts = []
    for index, _, _ in clouds:
        rows = (owner == index).nonzero()[:, 0]
        xyz_m = voxels.xyz_m[rows] - index * torch.tensor([_APART_M, 0.0, 0.0])
        parts.append(
            surfels_from_points(
                xyz_m,
                fill_colours(xyz_m, voxels.rgb[rows], voxels.has_colour[rows]),
                body=index,
                sh_degree=config.sh_degree,
                most_sigma_m=2 * voxels.size_m[rows],
            )
        )
    return parts


def _actor_footprint(
    points: MapPoints,
    track: ActorTrack,
    views: Sequence[TrainingView],
    config: InitialisationConfig,
) -> Float[Tensor, " points"]:
    """Size of a pixel at each point of an actor over its time; infinite if never near an image."""
    footprint = torch.full((len(points),), torch.inf)
    stride = math.ceil(len(views) / _MOST_VIEWS_PER_ACTOR)
    for view in views[::stride]:
        if not track.is_present(view.timestamp_ns):
            continue
        world_from_box = track.pose_at(view.timestamp_ns).float()
        at_time, _ = pixel_footprint(
            transform_points(world_from_box, points.xyz_m), [view.camera], aside_m=config.aside_m
        )
        footprint = torch.minimum(footprint, at_time)
    return footprint
