"""Which body each pixel of a view shows: the street, one of the actors, or the sky."""

import torch
from jaxtyping import Int
from torch import Tensor

from lidarpainter_models.gaussians.model.drawing import draw_gaussians
from lidarpainter_models.gaussians.model.gaussian_scene import GaussianScene
from lidarpainter_models.geometry.cameras import Camera

STREET = 0
SKY = 65535
"""As large as 16 bits allow: no drive has so many actors."""
_NUM_TOGETHER = 16  # actors drawn in one pass, a channel each


@torch.no_grad()
def instance_image(
    scene: GaussianScene, camera: Camera, timestamp_ns: int
) -> Int[Tensor, "height width"]:
    """The body that gives most of each pixel: 0 street, i + 1 the i-th track, `SKY` if clear.

    The Gaussians are those that `GaussianScene.render` draws; of the actors only those that the
    view shows are told apart, a few at a time, each as a channel of its own.
    """
    drawable = scene.drawable(camera, timestamp_ns)
    gaussians, bodies = drawable.gaussians, drawable.posed.bodies
    own = gaussians.body_index
    is_street = (own == STREET).float()[:, None]
    first = draw_gaussians(gaussians, bodies, camera, channels=is_street)
    best, shown = first.features[..., 0], torch.zeros_like(first.alpha, dtype=torch.int64)
    visible = torch.unique(own[first.visible & (own > STREET)])
    for first_row in range(0, len(visible), _NUM_TOGETHER):
        some = visible[first_row : first_row + _NUM_TOGETHER]
        channels = (own[:, None] == some).float()
        image = draw_gaussians(gaussians, bodies, camera, channels=channels)
        share, place = image.features.max(dim=-1)
        shown = torch.where(share > best, some[place].long(), shown)
        best = torch.maximum(best, share)
    return torch.where(first.alpha < 0.5, SKY, shown)
