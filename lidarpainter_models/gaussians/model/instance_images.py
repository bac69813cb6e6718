"""Which body each pixel of a view shows: the street, one of the actors, or the sky."""

import torch
from jaxtyping import Int
from torch import Tensor

from lidarpainter_models.gaussians.model.gaussian_scene import GaussianScene
from lidarpainter_models.gaussians.model.rolling_shutter import as_read
from lidarpainter_models.gaussians.model.scene_rendering import camera_from_body
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.kernels.backends import Backend
from lidarpainter_models.kernels.gaussian_raster import Splats, render_gaussians

STREET = 0
SKY = 65535
"""As large as 16 bits allow: no drive has so many actors."""
_NUM_TOGETHER = 16  # actors drawn in one pass, a channel each


def instance_image(
    scene: GaussianScene, camera: Camera, timestamp_ns: int, *, backend: Backend = "auto"
) -> Int[Tensor, "height width"]:
    """The body that gives most of each pixel: 0 street, i + 1 the i-th track, `SKY` if clear.

    Drawn as `GaussianScene.render` does, of the actors only those that the view shows, a few at a
    time, each as a channel of its own.
    """
    timestamp_ns = camera.taken_ns(timestamp_ns)
    with torch.no_grad():
        poses = scene.actors.likely_poses(timestamp_ns)
        bodies = camera_from_body(camera.world_from_camera, *poses)
        bent = scene.actors.bending.bent(scene.gaussians, timestamp_ns)
        gaussians = as_read(bent, bodies, camera, scene.actors, timestamp_ns)
        bodies = bodies.to(scene.device)
        splats = Splats(
            means=gaussians.means,
            rotation_wxyz=gaussians.rotation_wxyz,
            scale_m=gaussians.scale_m,
            opacity=gaussians.opacity,
            sh=scene.gaussians.sh_dc,
            body_index=gaussians.body_index,
        )
        own = gaussians.body_index
        is_street = (own == STREET).float()[:, None]
        first = render_gaussians(splats, bodies, camera, features=is_street, backend=backend)
        best, shown = first.features[..., 0], torch.zeros_like(first.alpha, dtype=torch.int64)
        visible = torch.unique(own[first.visible & (own > STREET)])
        for some in visible.split(_NUM_TOGETHER):
            channels = (own[:, None] == some).float()
            image = render_gaussians(splats, bodies, camera, features=channels, backend=backend)
            share, place = image.features.max(dim=-1)
            shown = torch.where(share > best, some[place].long(), shown)
            best = torch.maximum(best, share)
        return torch.where(first.alpha < 0.5, SKY, shown)
