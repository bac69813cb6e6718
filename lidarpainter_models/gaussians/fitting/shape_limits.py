"""Keep Gaussians from growing into needles along rays, films and giants.

A recorded view sees nothing of a Gaussian's extent along its ray; there the fit is free to draw
needles, which show as fans of streaks from anywhere else. Lengths are metres, in body frames.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from lidarpainter_models.gaussians.model.drawing import camera_from_body
from lidarpainter_models.gaussians.model.gaussian_scene import GaussianScene
from lidarpainter_models.gaussians.model.gaussian_set import GaussianSet, axes_at
from lidarpainter_models.geometry.transforms import invert_rigid
from lidarpainter_models.scenes.splits import sampled_rows

_ALONG = math.cos(math.radians(45))
_MOST_VIEWS = 32
LIMITS_EVERY = 50
"""Steps between two checks."""
STEADY_RAY = 0.985
"""Rays that differ more than about 10 degrees over the log pin a Gaussian's depth themselves: below
this length of the mean unit ray the stricter limit is off."""
MOST_ELONGATION = 12.0
"""Longest over middle axis: poles and wires need needles."""
MOST_ELONGATION_ALONG_RAY = 2.0
"""Longest over middle axis where that lies within 45 degrees of the viewing ray."""
MOST_SIGMA = 0.1
"""Longest axis in units of the distance to the nearest camera."""
LEAST_SIGMA_M = 0.003
"""Thinnest axis; the low-pass of a pixel is wider anyway."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ViewingRays:
    """How the training cameras saw each Gaussian, in its body frame."""

    mean_direction: Float[Tensor, "gaussians 3"]
    """Mean of the unit rays: short where they differ."""
    distance_m: Float[Tensor, " gaussians"]
    """Distance to the nearest camera."""


def viewing_rays(scene: GaussianScene) -> ViewingRays:
    """Directions and distances from the training cameras in whose front a Gaussian lies."""
    means = scene.gaussians.means.detach()
    body = scene.gaussians.body_index.long()
    rows = sampled_rows([camera_name for _, camera_name in scene.cameras.keys], _MOST_VIEWS)
    total = torch.zeros_like(means)
    count = means.new_zeros(len(means))
    distance_m = means.new_full((len(means),), torch.inf)
    with torch.no_grad():
        for row in rows:
            timestamp_ns = int(scene.cameras.timestamps_ns[row])
            actors = scene.actors.refined_poses_in_fit(timestamp_ns)
            body_from_camera = invert_rigid(
                camera_from_body(scene.cameras.world_from_camera(row), *actors)
            ).to(means.device, non_blocking=True)
            forward = body_from_camera[:, :3, 2].contiguous().index_select(0, body)
            offset = means - body_from_camera[:, :3, 3].contiguous().index_select(0, body)
            length = offset.norm(dim=1).clamp(min=1e-3)
            is_ahead = (offset * forward).sum(dim=1) > 0.5
            total.addcmul_(offset, (is_ahead / length)[:, None])
            count += is_ahead
            distance_m = torch.where(is_ahead, torch.minimum(distance_m, length), distance_m)
    return ViewingRays(
        mean_direction=total / count.clamp(min=1)[:, None],
        distance_m=torch.where(count > 0, distance_m, 50.0),
    )


def limit_shapes(gaussians: GaussianSet, rays: ViewingRays) -> None:
    """Shorten needles, thicken films and shrink giants, in place (`log_scale`)."""
    with torch.no_grad():
        ordered, order = gaussians.log_scale.sort(dim=1)
        direction = axes_at(gaussians.rotation_wxyz, order[:, 2])
        length = rays.mean_direction.norm(dim=1)
        along = (direction * rays.mean_direction).sum(dim=1).abs() / length.clamp(min=1e-3)
        is_needle = (along > _ALONG) & (length > STEADY_RAY)
        most = torch.where(is_needle, MOST_ELONGATION_ALONG_RAY, MOST_ELONGATION)
        limit = ordered[:, 1] + most.log()
        limit = torch.minimum(limit, (rays.distance_m * MOST_SIGMA).log())
        capped = torch.minimum(gaussians.log_scale, limit[:, None])
        gaussians.log_scale.copy_(capped.clamp(min=math.log(LEAST_SIGMA_M)))
