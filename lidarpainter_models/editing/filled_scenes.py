"""An edited world as it is stored: mended where somebody was, and masked for painters."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from lidarpainter_models.conditioning.conditions import ConditionBuilder
from lidarpainter_models.conditioning.settings import ConditionConfig
from lidarpainter_models.editing.ground_filling import fill_ground
from lidarpainter_models.editing.hole_filling import changed_pixels, fill_holes
from lidarpainter_models.editing.unseen_gaussians import without_unseen
from lidarpainter_models.editing.worlds import EditedWorld
from lidarpainter_models.gaussians.model.gaussian_scene import GaussianScene
from lidarpainter_models.observations.views import SceneObservations, TrainingView
from lidarpainter_models.painter.protocol import Painter


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
    changed = (*world.left, *world.came)
    views = tuple(_masked(world, view, changed) for view in world.views)
    return SceneObservations(views=views, lidar_map=world.lidar_map, tracks=world.moving)


def _masked(world: EditedWorld, view: TrainingView, changed: tuple) -> TrainingView:
    camera = world.scene.refined_camera(view)
    hidden = changed_pixels(changed, camera, view.timestamp_ns)
    if view.hidden is not None:
        hidden = hidden | view.hidden
    return replace(
        view,
        hidden=hidden,
        lidar_depth_m=torch.where(hidden, 0.0, view.lidar_depth_m),
    )


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
