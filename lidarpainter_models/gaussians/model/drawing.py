"""Draw Gaussians, actors' bodies in place, over their sky.

A Gaussian of an actor sits in the actor's box frame; at a time its centre and covariance are
carried by the actor's pose, mu = R_t mu_v + t_t and Sigma = R_t Sigma_v R_t^T (Street Gaussians,
Yan et al. 2024). Camera frame: x right, y down, z forward; world: z up; metres.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from lidarpainter_models.gaussians.model.seen_gaussians import DrawableGaussians
from lidarpainter_models.gaussians.model.sky import SkyTexture
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.geometry.transforms import invert_rigid
from lidarpainter_models.kernels.gaussian_raster import SplatImage, Splats, render_gaussians

OPAQUE = 1 - 1 / 512
"""From this opacity on the sky is not looked up: it would change no byte by more than half."""
_FAR_BEHIND_M = -1e6


@dataclass(frozen=True, kw_only=True, eq=False)
class SceneRender:
    """One rendered view."""

    rgb: Float[Tensor, "height width 3"]
    """Gaussians over sky, not clamped above 1."""
    depth_m: Float[Tensor, "height width"]
    """Expected camera z of what is seen; 0 where the Gaussians cover less than half."""
    alpha: Float[Tensor, "height width"]
    """Opacity of the Gaussians, before the sky."""
    actor_alpha: Float[Tensor, "height width"]
    """The part of alpha that belongs to actors."""


def camera_from_body(
    world_from_camera: Float[Tensor, "4 4"],
    world_from_actors: Float[Tensor, "actors 4 4"],
    present: Float[Tensor, " actors"],
) -> Float[Tensor, "bodies 4 4"]:
    """Where every body stands in the camera; differentiable in the poses, float32, on the CPU.

    Absent actors are put far behind the camera, where nothing is drawn.
    """
    camera_from_world = invert_rigid(world_from_camera.double())
    if len(world_from_actors) == 0:
        return camera_from_world[None].float()
    absent = torch.eye(4, dtype=torch.float64)
    absent[2, 3] = _FAR_BEHIND_M
    is_present = present[:, None, None] > 0
    camera_from_actor = torch.where(is_present, camera_from_world @ world_from_actors, absent)
    return torch.cat([camera_from_world[None], camera_from_actor]).float()


def draw_gaussians(
    gaussians: DrawableGaussians,
    bodies: Float[Tensor, "bodies 4 4"],
    camera: Camera,
    *,
    with_actor_alpha: bool = False,
    channels: Float[Tensor, "gaussians channels"] | None = None,
    screen_gradient_out: Float[Tensor, " gaussians"] | None = None,
) -> SplatImage:
    """Blend Gaussians whose bodies stand before the camera like this, without sky.

    The image's features are the actors' alpha if it is wanted, then the `channels` if given.
    """
    features = [(gaussians.body_index > 0).float()[:, None]] if with_actor_alpha else []
    features += [] if channels is None else [channels]
    splats = Splats(
        means=gaussians.means,
        rotation_wxyz=gaussians.rotation_wxyz,
        scale_m=gaussians.scale_m,
        opacity=gaussians.opacity,
        sh=gaussians.sh,
        body_index=gaussians.body_index,
    )
    return render_gaussians(
        splats,
        bodies.to(gaussians.means.device, non_blocking=True),
        camera,
        features=torch.cat(features, dim=1) if features else None,
        screen_gradient_out=screen_gradient_out,
    )


@torch.no_grad()
def draw_over_sky(
    gaussians: DrawableGaussians,
    bodies: Float[Tensor, "bodies 4 4"],
    sky: SkyTexture,
    camera: Camera,
) -> SceneRender:
    """The view of a camera, without gradient."""
    image = draw_gaussians(gaussians, bodies, camera, with_actor_alpha=True)
    clear = (1 - image.alpha)[..., None]
    rgb = image.rgb + clear * sky.sample(sky.rays(camera, image.alpha < OPAQUE))
    depth_m = image.depth_m / image.alpha.clamp(min=1e-4)
    return SceneRender(
        rgb=rgb,
        depth_m=torch.where(image.alpha >= 0.5, depth_m, 0.0),
        alpha=image.alpha,
        actor_alpha=image.features[..., 0],
    )
