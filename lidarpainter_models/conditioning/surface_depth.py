"""The depth of a view's surfaces from its render and its LiDAR image.

A render's depth is a mean over soft Gaussians: good to a percent, which at ten metres carries an
image taken three metres aside to the wrong place by a pixel or two. LiDAR is three times as
good (medians on a synthetic street) but has gaps; in these the render is scaled as LiDAR found it
wrong around them. Depth is camera z in metres, 0 where there is none.
"""

import cv2
import torch
from jaxtyping import Float
from torch import Tensor

_LEAST_SHARE = 1e-3  # of LiDAR pixels around, below which there is nothing to go by
ONE_SURFACE = 0.15
"""Up to this relative difference render and LiDAR show one surface; beyond it the LiDAR may
have looked past an edge or through a window, and the render stands."""
REACH_RAD = 0.004
"""Deviation of the blur that carries corrections into gaps: 2 px at 500 px focal length."""


def surface_depth(
    render_depth_m: Float[Tensor, "height width"],
    lidar_depth_m: Float[Tensor, "height width"],
    focal_px: float,
) -> Float[Tensor, "height width"]:
    """LiDAR where both see one surface, the corrected render elsewhere; 0 where that is 0."""
    has_both = (render_depth_m > 0) & (lidar_depth_m > 0)
    ratio = torch.where(has_both, lidar_depth_m / render_depth_m.clamp_min(1e-3), 1)
    agrees = has_both & ((ratio - 1).abs() < ONE_SURFACE)
    found = torch.stack([torch.where(agrees, ratio.log(), 0), agrees.float()], dim=-1)
    spread = cv2.GaussianBlur(found.numpy(), (0, 0), REACH_RAD * focal_px)
    change, share = torch.from_numpy(spread).unbind(-1)
    factor = torch.where(share > _LEAST_SHARE, change / share.clamp_min(_LEAST_SHARE), 0).exp()
    return torch.where(agrees, lidar_depth_m, render_depth_m * factor)
