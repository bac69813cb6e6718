"""An edited world as it is stored: mended where somebody was, and masked for painters."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from scipy.spatial import cKDTree
from torch import Tensor

from lidarpainter_models.conditioning.conditions import ConditionBuilder
from lidarpainter_models.conditioning.settings import ConditionConfig
from lidarpainter_models.editing.ground_filling import fill_ground
from lidarpainter_models.editing.hole_filling import (
    changed_pixels,
    fill_holes,
    inside_boxes,
    shown_actors,
)
from lidarpainter_models.editing.worlds import EditedWorld
from lidarpainter_models.gaussians.model.gaussian_scene import GaussianScene
from lidarpainter_models.gaussians.model.gaussian_set import GaussianSet, sh_from_rgb
from lidarpainter_models.geometry.boxes import is_inside_box
from lidarpainter_models.lidar.lidar_map import MapPoints
from lidarpainter_models.observations.views import SceneObservations, TrainingView
from lidarpainter_models.painter.protocol import Painter
from lidarpainter_models.scenes.splits import sampled_views
from lidarpainter_models.scenes.tracks import ActorTrack

MOST_VIEWS = 40
"""Spread over the log; neighbours show the same."""
BEHIND = 0.03  # of its depth: so far behind the surface of a pixel a Gaussian still shows
NEAR_ACTOR_M = 0.8
"""So far around its box an actor is smeared."""
NEAR_PARKED_M = 0.3
NEAR_POINT_M = 0.2
"""A LiDAR point so near to a Gaussian measured its surface."""


def without_unseen(
    scene: GaussianScene,
    fitted: GaussianScene,
    views: Sequence[TrainingView],
    left: Sequence[ActorTrack],
    street: MapPoints,
) -> GaussianScene:
    """The edited scene without what nobody has seen.

    Args:
        scene: edited; its Gaussians of the street are looked at.
        fitted: as it was before, whose surfaces hid what was behind.
        views: recorded ones, their cameras where the fit found them to be.
        left: who has gone.
        street: LiDAR points without those of whoever has gone.
    """
    gaussians = scene.gaussians
    was_shown, was_covered = _shown(gaussians.means.detach(), fitted, views, left)
    doubted = (was_covered & ~was_shown & (gaussians.body_index == 0)).nonzero()[:, 0]
    if not len(doubted):
        return scene
    parked = [track for track in left if not track.is_moving]
    rgb, is_measured = _measured(gaussians.means[doubted], _clean(street, parked))
    columns = gaussians.columns()
    kept = doubted[is_measured]
    for name in ("sh_dc", "sh_rest"):
        columns[name] = columns[name].clone()
    columns["sh_dc"][kept] = sh_from_rgb(rgb[is_measured])
    columns["sh_rest"][kept] = 0
    is_near = torch.zeros(len(doubted), dtype=torch.bool)
    for track in left:
        is_near |= inside_boxes(gaussians.means[doubted], track.world_from_box, track, NEAR_ACTOR_M)
    stays = torch.ones(len(gaussians), dtype=torch.bool)
    stays[doubted[~is_measured & is_near]] = False
    return scene.with_gaussians(GaussianSet(**columns).select(stays.nonzero()[:, 0]))


def _shown(
    means: Float[Tensor, "gaussians 3"],
    fitted: GaussianScene,
    views: Sequence[TrainingView],
    left: Sequence[ActorTrack],
) -> tuple[Bool[Tensor, " gaussians"], Bool[Tensor, " gaussians"]]:
    """Which Gaussians showed outside the actors' outlines, and which lay inside them."""
    was_shown = torch.zeros(len(means), dtype=torch.bool)
    was_covered = torch.zeros_like(was_shown)
    for view in sampled_views(views, MOST_VIEWS):
        camera = view.camera
        surface = fitted.render(camera, view.timestamp_ns).depth_m
        covered = shown_actors(camera, surface, view.timestamp_ns, left)
        pixels_uv, depth_m = camera.project(means)
        inside = camera.contains(pixels_uv, depth_m).nonzero()[:, 0]
        column, row = pixels_uv[inside].long().unbind(1)
        is_in = covered[row, column]
        surface_m = surface[row, column]
        in_front = (surface_m == 0) | (depth_m[inside] <= surface_m * (1 + BEHIND))
        was_shown[inside[~is_in & in_front]] = True
        was_covered[inside[is_in]] = True
    return was_shown, was_covered


def _clean(street: MapPoints, parked: Sequence[ActorTrack]) -> MapPoints:
    """Coloured points that no parked car gave its colour: images of the road under it show it."""
    touched = ~street.has_colour
    for track in parked:
        size_m = track.size_m + 2 * NEAR_PARKED_M
        touched |= is_inside_box(street.xyz_m, track.world_from_box[0], size_m)
    return street.keep(~touched)


def _measured(
    means: Float[Tensor, "gaussians 3"], street: MapPoints
) -> tuple[Float[Tensor, "gaussians 3"], Bool[Tensor, " gaussians"]]:
    """Colour of the nearest coloured LiDAR point, and whether it is near enough."""
    low, high = means.amin(0) - NEAR_POINT_M, means.amax(0) + NEAR_POINT_M
    inside = ((street.xyz_m >= low) & (street.xyz_m <= high)).all(dim=1)
    rows = inside.nonzero()[:, 0]
    if not len(rows):
        return torch.zeros(len(means), 3), torch.zeros(len(means), dtype=torch.bool)
    tree = cKDTree(street.xyz_m[rows].numpy())
    distance_m, nearest = tree.query(means.numpy(), distance_upper_bound=NEAR_POINT_M)
    found = torch.from_numpy(distance_m).isfinite()
    chosen = rows[torch.from_numpy(nearest).clamp(max=len(rows) - 1)]
    return street.rgb_u8[chosen].float() / 255, found


@dataclass(frozen=True, kw_only=True, eq=False)
class FilledScene:
    """A scene whose last Gaussians were filled in."""

    scene: GaussianScene
    confidence: Float[Tensor, " filled"]
    """How far each of these can be trusted, in their order: 1 is as good as fitted."""
    num_ground: int
    """How many of them are road; the others stand behind somebody who has gone."""


def masked_observations(world: EditedWorld) -> SceneObservations:
    """What may be seen of an edited world: images hide where somebody came or left."""
    changed, views = (*world.left, *world.came), []
    for view in world.views:
        hidden = changed_pixels(changed, world.scene.refined_camera(view), view.timestamp_ns)
        if view.hidden is not None:
            hidden = hidden | view.hidden
        depth_m = torch.where(hidden, 0.0, view.lidar_depth_m)
        views.append(replace(view, hidden=hidden, lidar_depth_m=depth_m))
    return SceneObservations(views=tuple(views), lidar_map=world.lidar_map, tracks=world.moving)


def filled(world: EditedWorld, config: ConditionConfig, painter: Painter | None) -> FilledScene:
    """The scene of an edited world, with what its edits have uncovered."""
    seen, street = masked_observations(world), world.lidar_map.street
    refined = [replace(view, camera=world.scene.refined_camera(view)) for view in world.views]
    scene = without_unseen(world.scene, world.fitted, refined, world.left, street)
    scene, road = fill_ground(scene, street, world.ground, world.left)
    scene = road.added_to(scene)
    builder = ConditionBuilder(scene, seen.lidar_map, seen.views, config=config)
    behind = fill_holes(builder, world.fitted, builder.refined_views, world.left, painter)
    return FilledScene(
        scene=behind.added_to(scene),
        confidence=torch.cat([road.confidence, behind.confidence]),
        num_ground=len(road.gaussians),
    )
