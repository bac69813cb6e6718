"""The depth of a view's surfaces from its render and its LiDAR image.

A render's depth is a mean over soft Gaussians: good to a percent, which at ten metres carries an
image taken three metres aside to the wrong place by a pixel or two. LiDAR is three times as
good (medians on a synthetic street) but has gaps; in these the render is scaled as LiDAR found it
wrong around them. Depth is camera z in metres, 0 where there is none.
"""

from dataclasses import dataclass

import cv2
import torch
from jaxtyping import Float
from torch import Tensor

from lidarpainter_models.errors import ConfigError

_LEAST_SHARE = 1e-3  # of LiDAR pixels around, below which there is nothing to go by


@dataclass(frozen=True, slots=True, kw_only=True)
class SurfaceDepthConfig:
    """How LiDAR corrects a render's depth."""

    one_surface: float = 0.15
    """Up to this relative difference render and LiDAR show one surface; beyond it the LiDAR may
    have looked past an edge or through a window, and the render stands."""
    reach_rad: float = 0.004
    """Deviation of the blur that carries corrections into gaps: 2 px at 500 px focal length."""

    def __post_init__(self) -> None:
        """Refuse settings that correct nothing."""
        if not (0 < self.one_surface < 1 and self.reach_rad > 0):
            raise ConfigError(
                f"need 0 < one_surface < 1 and reach_rad > 0, got {self.one_surface} and "
                f"{self.reach_rad}"
            )


def surface_depth(
    render_depth_m: Float[Tensor, "height width"],
    lidar_depth_m: Float[Tensor, "height width"],
    focal_px: float,
    config: SurfaceDepthConfig,
) -> Float[Tensor, "height width"]:
    """LiDAR where both see one surface, the corrected render elsewhere; 0 where that is 0."""
    has_both = (render_depth_m > 0) & (lidar_depth_m > 0)
    ratio = torch.where(has_both, lidar_depth_m / render_depth_m.clamp_min(1e-3), 1)
    agrees = has_both & ((ratio - 1).abs() < config.one_surface)
    found = torch.stack([torch.where(agrees, ratio.log(), 0), agrees.float()], dim=-1)
    spread = cv2.GaussianBlur(found.numpy(), (0, 0), config.reach_rad * focal_px)
    change, share = torch.from_numpy(spread).unbind(-1)
    factor = torch.where(share > _LEAST_SHARE, change / share.clamp_min(_LEAST_SHARE), 0).exp()
    return torch.where(agrees, lidar_depth_m, render_depth_m * factor)
