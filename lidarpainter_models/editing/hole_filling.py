"""What stands behind somebody who has gone, where no fitted Gaussian closes the view.

Some recorded views are looked at again without the actor. A pixel that it covered and that is clear
now, between surfaces that are not, is a hole; it gets its depth from LiDAR points of other frames
or from around it, its colour from LiDAR, else from recorded images of other places (warped), else
from the painter, and becomes a Gaussian. Depth is camera z in metres.
"""

from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from lidarpainter_models.conditioning.conditions import ConditionBuilder
from lidarpainter_models.editing.ground_filling import Filling
from lidarpainter_models.gaussians.model.gaussian_scene import GaussianScene
from lidarpainter_models.gaussians.model.gaussian_set import GaussianSet, sh_from_rgb
from lidarpainter_models.gaussians.model.sky import push_pull
from lidarpainter_models.geometry.box_masks import project_boxes
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.geometry.transforms import invert_rigid
from lidarpainter_models.kernels.box_owners import NO_BOX, box_owners
from lidarpainter_models.observations.views import TrainingView
from lidarpainter_models.painter.protocol import Painter, PaintingConditions
from lidarpainter_models.scenes.splits import sampled_views
from lidarpainter_models.scenes.tracks import ActorTrack

MOST_VIEWS = 6
"""Views that are looked at, spread over the log: what one fills is closed in the next."""
STEP_PX = 2
OPEN = 0.8  # opacity under which a pixel is clear
CLOSED = 0.95  # opacity from which a pixel shows no sky through its surface
LIDAR_CONFIDENCE, WARP_CONFIDENCE, PAINTED_CONFIDENCE = 0.8, 0.7, 0.4
OUTLINE_M = 0.15
"""A surface so near to a box is the actor's."""
FLOOR_M = 0.1
"""What is lower over the bottom of a box is road."""
MARGIN_M = 0.5
"""Boxes are grown by this much: outlines are soft, and shadows lie beside them."""


def changed_pixels(
    tracks: Sequence[ActorTrack], camera: Camera, timestamp_ns: int
) -> Bool[Tensor, "height width"]:
    """What of an image the boxes of some actors cover, those that are there."""
    here = [track for track in tracks if track.is_present(timestamp_ns)]
    if not here:
        return torch.zeros(camera.height_px, camera.width_px, dtype=torch.bool)
    return project_boxes(
        camera,
        torch.stack([track.pose_at(timestamp_ns) for track in here]),
        [track.size_m + MARGIN_M for track in here],
        torch.ones(len(here), dtype=torch.bool),
        margin=1.0,
    )


def shown_actors(
    camera: Camera,
    depth_m: Float[Tensor, "height width"],
    timestamp_ns: int,
    left: Sequence[ActorTrack],
) -> Bool[Tensor, "height width"]:
    """Pixels whose surface lies in the box of an actor."""
    shown = torch.zeros_like(depth_m, dtype=torch.bool)
    wanted = changed_pixels(left, camera, timestamp_ns) & (depth_m > 0)
    points = camera.unproject(depth_m)[wanted].float()
    for track in left:
        if len(points) and track.is_present(timestamp_ns):
            pose = track.pose_at(timestamp_ns)[None]
            shown[wanted] |= inside_boxes(points, pose, track, OUTLINE_M)
    return shown


def inside_boxes(
    points_world: Float[Tensor, "points 3"],
    world_from_box: Float[Tensor, "times 4 4"],
    track: ActorTrack,
    margin_m: float,
) -> Bool[Tensor, " points"]:
    """Points in the grown box of an actor at any of some times, but above the road."""
    poses = world_from_box.double()
    lifted = poses.clone()
    lifted[:, :3, 3] += (margin_m + FLOOR_M) / 2 * poses[:, :3, 2]
    grown_m = track.size_m + torch.tensor([2 * margin_m, 2 * margin_m, margin_m - FLOOR_M])
    boxes = invert_rigid(lifted), grown_m.expand(len(poses), 3)
    return box_owners(points_world, *boxes, margin_m=0.0, floor_m=0.0) != NO_BOX


def fill_holes(
    builder: ConditionBuilder,
    fitted: GaussianScene,
    views: Sequence[TrainingView],
    left: Sequence[ActorTrack],
    painter: Painter | None,
) -> Filling:
    """Close the holes that actors left in some views.

    Args:
        builder: of the edited scene, whose images and points are masked where it was edited.
        fitted: the scene as it was before.
        views: the recorded ones, their cameras as found by the fit.
        left: who is not there any more.
        painter: has the last word on colours; None leaves that to what is around.
    """
    scene, confidence = builder.scene, [torch.zeros(0)]
    num_before = len(scene.gaussians)
    shown = [
        view for view in views if bool(changed_pixels(left, view.camera, view.timestamp_ns).any())
    ]
    for view in sampled_views(shown, MOST_VIEWS):
        before_m = fitted.render(view.camera, view.timestamp_ns).depth_m
        covered = shown_actors(view.camera, before_m, view.timestamp_ns, left)
        render = scene.render(view.camera, view.timestamp_ns)
        holes = _holes(render.alpha, covered)
        if not bool(holes.any()):
            continue
        conditions = builder.conditions(view.camera, view.timestamp_ns)
        conditions = replace(conditions, render_rgb=render.rgb.clamp(0, 1))
        filling = _lifted(conditions, view.camera, holes, painter, scene.gaussians.sh_degree)
        confidence.append(filling.confidence)
        scene = filling.added_to(scene)
    added = scene.gaussians.select(torch.arange(num_before, len(scene.gaussians)))
    return Filling(gaussians=added, confidence=torch.cat(confidence))


def _holes(
    alpha: Float[Tensor, "height width"], covered: Bool[Tensor, "height width"]
) -> Bool[Tensor, "height width"]:
    """Clear pixels where the surroundings say that something opaque should be."""
    around = push_pull(alpha[..., None].expand(-1, -1, 3), (~covered).float())[..., 0]
    return covered & (alpha < OPEN) & (around >= 0.5)


def _lifted(
    conditions: PaintingConditions,
    camera: Camera,
    holes: Bool[Tensor, "height width"],
    painter: Painter | None,
    sh_degree: int,
) -> Filling:
    """Gaussians in the holes of a view."""
    known_m = torch.where(holes, conditions.lidar_depth_m, conditions.render_depth_m)
    has_depth = known_m > 0
    inverse = torch.where(has_depth, 1 / known_m.clamp(min=0.1), 0.0)
    smooth = push_pull(inverse[..., None].expand(-1, -1, 3), has_depth.float())[..., 0]
    depth_m = 1 / smooth.clamp(min=1e-3)
    rgb, confidence = _coloured(conditions, holes, painter)
    chosen = torch.zeros_like(holes)
    chosen[::STEP_PX, ::STEP_PX] = holes[::STEP_PX, ::STEP_PX]
    points = camera.unproject(depth_m)[chosen].float()
    count = len(points)
    size_m = (0.6 * STEP_PX / camera.fx_px) * depth_m[chosen]
    gaussians = GaussianSet(
        means=points,
        rotation_wxyz=torch.tensor([1.0, 0, 0, 0]).repeat(count, 1),
        log_scale=size_m.log()[:, None].repeat(1, 3),
        opacity_logit=torch.full((count,), 0.9).logit(),
        sh_dc=sh_from_rgb(rgb[chosen]),
        sh_rest=torch.zeros(count, (sh_degree + 1) ** 2 - 1, 3),
        body_index=torch.zeros(count, dtype=torch.int32),
    )
    return Filling(gaussians=gaussians, confidence=confidence[chosen])


def _coloured(
    conditions: PaintingConditions, holes: Bool[Tensor, "height width"], painter: Painter | None
) -> tuple[Float[Tensor, "height width 3"], Float[Tensor, "height width"]]:
    """The best known colour of every pixel, and how far it can be trusted."""
    solid = ~holes & (conditions.render_alpha >= CLOSED)
    rgb = push_pull(conditions.render_rgb, solid.float())
    confidence = torch.zeros_like(conditions.render_alpha)
    if painter is not None:
        with torch.inference_mode():
            painting = painter.paint(replace(conditions, render_rgb=rgb))
        rgb, confidence = painting.rgb.clone(), PAINTED_CONFIDENCE * painting.confidence
    for source in reversed(range(len(conditions.warp_valid))):
        valid = conditions.warp_valid[source]
        rgb = torch.where(valid[..., None], conditions.warp_rgb[source], rgb)
        confidence = torch.where(valid, WARP_CONFIDENCE, confidence)
    rgb = torch.where(conditions.lidar_hit[..., None], conditions.lidar_rgb, rgb)
    return rgb, torch.where(conditions.lidar_hit, LIDAR_CONFIDENCE, confidence)
