"""Gaussians for what images show and LiDAR never reached: upper floors, far towers, wires.

Where the first scene, drawn into a training view, leaves a pixel clear that is not sky, a Gaussian
is put at a depth found by comparing training images. Without them the fit would stretch
whatever is near into these places, or leave them to the sky texture, which has no depth.
"""

from collections.abc import Callable, Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from lidarpainter_models.gaussians.model.gaussian_scene import GaussianScene, SceneRender
from lidarpainter_models.gaussians.model.gaussian_set import GaussianSet, sh_from_rgb
from lidarpainter_models.geometry.box_masks import project_boxes
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.geometry.transforms import quaternion_from_rotation
from lidarpainter_models.kernels.side_by_side import side_by_side
from lidarpainter_models.lidar.ground_heights import GroundHeights
from lidarpainter_models.observations.image_shrinking import shrink_image
from lidarpainter_models.observations.plane_sweep import choose_depth, sweep_cost, sweep_depths
from lidarpainter_models.observations.views import TrainingView

COMPARED_VIEWS = 3
"""Other views of the same camera that each is compared with."""
STRIDE_PX = 3
"""Pixels between two Gaussians; splitting refines them later."""
PRIOR = 0.03
"""Colour difference for which a depth far from the surroundings' is believed."""
OPACITY = 0.6
"""First opacity."""
VIEWS_PER_CAMERA = 4  # training views that are looked at, evenly over the log
MOST_SHARE = 0.12  # at most this part of the start size; a larger stride is taken if need be
NEAREST_M = 8.0  # nearer things are within every LiDAR's reach
FARTHEST_M = 800.0  # beyond it a lane's width moves nothing by a pixel
DEPTHS_M = sweep_depths(NEAREST_M, FARTHEST_M, 64)
"""Depths compared: between two, what stands 100 m away and aside moves by a window or less."""
SWEPT_PX = 640
"""Images are compared so wide at most."""
MOST_BELOW_GROUND_M = 1.0
"""Deeper ones are dropped; roads fall away further than the LiDAR sees them."""


def unreached_gaussians(
    scene: GaussianScene,
    views: Sequence[TrainingView],
    *,
    budget: int,
    progress: Callable[[float], None] = lambda _: None,
) -> GaussianSet:
    """Gaussians that close the clear places of the training views which are not sky."""
    found = GaussianSet.empty(sh_degree=scene.gaussians.sh_degree)
    street = scene.gaussians.means[scene.gaussians.body_index == 0].detach()
    ground = GroundHeights(street, least_points=2)
    cameras = sorted({view.key[1] for view in views})
    chosen = [
        (view, of_camera)
        for name in cameras
        for of_camera in [[view for view in views if view.key[1] == name]]
        for view in _evenly(of_camera, VIEWS_PER_CAMERA)
    ]
    costs = side_by_side(lambda one: _cost_of_depths(scene, *one), chosen, scene.device)
    for done, ((view, _), cost) in enumerate(zip(chosen, costs, strict=True)):
        rest = budget - len(found)
        share = rest // (len(chosen) - done)
        if cost is not None and share > 0:
            grown = scene.with_gaussians(scene.gaussians.append(found))
            seeds = _seeds_of_view(grown, view, cost, budget=share)
            found = found.append(_above_ground(seeds, ground))
        progress((done + 1) / len(chosen))
    return found


def _cost_of_depths(
    scene: GaussianScene, view: TrainingView, of_camera: Sequence[TrainingView]
) -> Float[Tensor, "depths height width"] | None:
    """How badly others of a camera agree with a view at each depth; None where nobody asks."""
    others = [other for other in of_camera if other.key != view.key]
    if not others or not bool(_open_places(scene, view, _render(scene, view)).any()):
        return None
    compared = [_swept(other) for other in _evenly(others, COMPARED_VIEWS)]
    return sweep_cost(*_swept(view), compared, DEPTHS_M)


def _swept(view: TrainingView) -> tuple[Camera, Float[Tensor, "rows columns 3"]]:
    """A view as it is compared with others."""
    camera = view.camera.no_wider(SWEPT_PX)
    image = shrink_image(view.rgb_u8, width_px=camera.width_px, height_px=camera.height_px)
    return camera, image.float() / 255


def _seeds_of_view(
    scene: GaussianScene,
    view: TrainingView,
    cost: Float[Tensor, "depths height width"],
    *,
    budget: int,
) -> GaussianSet:
    """The Gaussians that one view asks for."""
    render = _render(scene, view)
    is_open = _open_places(scene, view, render)
    stride = max(STRIDE_PX, int((int(is_open.sum()) / budget) ** 0.5) + 1)
    expected_m = _resized(depth_from_below(render.depth_m), *cost.shape[1:])
    depth_m = choose_depth(cost, DEPTHS_M, expected_m, prior=PRIOR)
    depth_m = _resized(depth_m, *is_open.shape)
    grid = torch.zeros_like(is_open)
    grid[stride // 2 :: stride, stride // 2 :: stride] = True
    rgb = scene.exposure.undone(view.rgb, view.key[1], view.timestamp_ns)
    return _facing_discs(view.camera, rgb, depth_m, is_open & grid, stride, scene.gaussians)


def _resized(
    image: Float[Tensor, "height width"], height_px: int, width_px: int
) -> Float[Tensor, "rows columns"]:
    """An image of another size, its nearest pixels."""
    return torch.nn.functional.interpolate(image[None, None], (height_px, width_px))[0, 0]


def _render(scene: GaussianScene, view: TrainingView) -> SceneRender:
    return scene.render(view.camera, view.timestamp_ns)


def _open_places(
    scene: GaussianScene, view: TrainingView, render: SceneRender
) -> Bool[Tensor, "height width"]:
    """Pixels of what stands still and is not sky, through which the scene can be looked."""
    is_open = (render.alpha < 0.5) & view.shows_surface & ~_moving(scene, view)
    return is_open & ~_thin(is_open)


def _above_ground(seeds: GaussianSet, ground: GroundHeights) -> GaussianSet:
    """Without those that a gap in the road let through to the underworld."""
    height_m = ground.around(seeds.means[:, :2])
    is_below = seeds.means[:, 2] < height_m - MOST_BELOW_GROUND_M
    return seeds.select((~is_below).nonzero()[:, 0])


def depth_from_below(depth_m: Float[Tensor, "height width"]) -> Float[Tensor, "height width"]:
    """Continue each column's depth upwards over its gaps: walls go straight up.

    Where nothing is below, it is very far.
    """
    filled = depth_m.clone()
    for row in range(filled.shape[0] - 2, -1, -1):
        filled[row] = torch.where(filled[row] > 0, filled[row], filled[row + 1])
    return torch.where(filled > 0, filled, FARTHEST_M)


def _facing_discs(
    camera: Camera,
    rgb: Float[Tensor, "height width 3"],
    depth_m: Float[Tensor, "height width"],
    chosen: Bool[Tensor, "height width"],
    stride: int,
    like: GaussianSet,
) -> GaussianSet:
    """Discs that face the camera at the chosen pixels."""
    xyz_m = camera.unproject(depth_m)[chosen]
    sigma_m = 0.6 * stride * depth_m[chosen] / camera.fx_px
    rotation = camera.world_from_camera[:3, :3]
    count = xyz_m.shape[0]
    return GaussianSet(
        means=xyz_m,
        rotation_wxyz=quaternion_from_rotation(rotation).float().expand(count, 4).clone(),
        log_scale=torch.stack([sigma_m, sigma_m, 0.3 * sigma_m], dim=1).log(),
        opacity_logit=torch.logit(torch.full((count,), OPACITY)),
        sh_dc=sh_from_rgb(rgb[chosen]),
        sh_rest=torch.zeros(count, like.sh_rest.shape[1], 3),
        body_index=torch.zeros(count, dtype=torch.int32),
    )


def _moving(scene: GaussianScene, view: TrainingView) -> Bool[Tensor, "height width"]:
    """Pixels of moving actors: what is clear there belongs to them."""
    if not scene.actors.recorded_tracks:
        return torch.zeros_like(view.sky_mask)
    with torch.no_grad():
        poses, present = scene.actors.refined_poses_in_fit(view.camera.taken_ns(view.timestamp_ns))
    sizes = [track.size_m for track in scene.actors.recorded_tracks]
    return project_boxes(view.camera, poses, sizes, present > 0)


def _thin(mask: Bool[Tensor, "height width"]) -> Bool[Tensor, "height width"]:
    """Pixels of the mask that a 3 x 3 opening would remove: slits between splats."""
    pooled = torch.nn.functional.max_pool2d
    eroded = -pooled(-mask.float()[None], 3, 1, 1)
    return mask & (pooled(eroded, 3, 1, 1)[0] < 0.5)


def _evenly(views: Sequence[TrainingView], count: int) -> list[TrainingView]:
    """At most `count` of the views, ends included."""
    if len(views) <= count:
        return list(views)
    if count == 1:
        return [views[len(views) // 2]]
    return [views[round(i * (len(views) - 1) / (count - 1))] for i in range(count)]
