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

from lidarpainter_models.kernels.backends import may_run_on_host

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
    change, share = _blurred(found, REACH_RAD * focal_px).unbind(-1)
    factor = torch.where(share > _LEAST_SHARE, change / share.clamp_min(_LEAST_SHARE), 0).exp()
    return torch.where(agrees, lidar_depth_m, render_depth_m * factor)


def _blurred(
    image: Float[Tensor, "height width 2"], sigma_px: float
) -> Float[Tensor, "height width 2"]:
    """A Gaussian blur that mirrors the image at its border, as OpenCV's by default."""
    if may_run_on_host(image.device):
        return torch.from_numpy(cv2.GaussianBlur(image.numpy(), (0, 0), sigma_px))
    radius_px = round(8 * sigma_px + 1) // 2
    offset = torch.arange(-radius_px, radius_px + 1, device=image.device, dtype=image.dtype)
    weights = torch.exp(-(offset**2) / (2 * sigma_px**2))
    weights = weights / weights.sum()
    planes = image.permute(2, 0, 1)[:, None]
    for shape, sides in (
        ((1, -1), (radius_px, radius_px, 0, 0)),
        ((-1, 1), (0, 0, radius_px, radius_px)),
    ):
        padded = torch.nn.functional.pad(planes, sides, mode="reflect")
        planes = torch.nn.functional.conv2d(padded, weights.view(1, 1, *shape))
    return planes[:, 0].permute(1, 2, 0)
