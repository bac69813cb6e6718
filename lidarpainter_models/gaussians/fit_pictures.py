"""Training pictures at full and half size, ready for a step of the fit."""

from dataclasses import dataclass

import cv2
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from lidarpainter_models.gaussians.observations import TrainingView, shrink_picture
from lidarpainter_models.geometry.cameras import Camera


@dataclass(frozen=True, kw_only=True, eq=False)
class FitPicture:
    """One training view at one size."""

    camera: Camera
    """As recorded."""
    timestamp_ns: int
    camera_name: str
    rgb_u8: UInt8[Tensor, "height width 3"]
    sky_mask: Bool[Tensor, "height width"]
    lidar_depth_m: Float[Tensor, "height width"]
    solid_mask: Bool[Tensor, "height width"]
    """Pixels on or beside a LiDAR return that are not sky."""

    @property
    def rgb(self) -> Float[Tensor, "height width 3"]:
        """The picture as floats."""
        return self.rgb_u8.float() / 255


def full_picture(view: TrainingView) -> FitPicture:
    """The view as it is."""
    return FitPicture(
        camera=view.camera,
        timestamp_ns=view.timestamp_ns,
        camera_name=view.key[1],
        rgb_u8=view.rgb_u8,
        sky_mask=view.sky_mask,
        lidar_depth_m=view.lidar_depth_m,
        solid_mask=solid_pixels(view.lidar_depth_m, view.sky_mask),
    )


def half_picture(view: TrainingView) -> FitPicture:
    """The view at half size: area-averaged colours, mostly-sky mask, nearest depths."""
    width_px = max(view.camera.width_px // 2, 1)
    height_px = max(view.camera.height_px // 2, 1)
    mask = cv2.resize(
        view.sky_mask.float().numpy(), (width_px, height_px), interpolation=cv2.INTER_AREA
    )
    depth_m = shrink_depth(view.lidar_depth_m, width_px=width_px, height_px=height_px)
    sky_mask = torch.from_numpy(mask) > 0.5
    return FitPicture(
        camera=view.camera.resized(width_px=width_px, height_px=height_px),
        timestamp_ns=view.timestamp_ns,
        camera_name=view.key[1],
        rgb_u8=shrink_picture(view.rgb_u8, width_px=width_px, height_px=height_px),
        sky_mask=sky_mask,
        lidar_depth_m=depth_m,
        solid_mask=solid_pixels(depth_m, sky_mask),
    )


def solid_pixels(
    lidar_depth_m: Float[Tensor, "height width"], sky_mask: Bool[Tensor, "height width"]
) -> Bool[Tensor, "height width"]:
    """Pixels at most one away from a LiDAR return, without the sky."""
    beside = torch.nn.functional.max_pool2d((lidar_depth_m > 0).float()[None], 3, 1, 1)[0]
    return (beside > 0) & ~sky_mask


def shrink_depth(
    depth_m: Float[Tensor, "height width"], *, width_px: int, height_px: int
) -> Float[Tensor, "rows columns"]:
    """A sparse depth picture on a coarser grid; the nearest depth of each cell wins."""
    rows, columns = depth_m.nonzero(as_tuple=True)
    cells = (rows * height_px // depth_m.shape[0]) * width_px
    cells = cells + columns * width_px // depth_m.shape[1]
    nearest = torch.full((height_px * width_px,), torch.inf)
    nearest.scatter_reduce_(0, cells, depth_m[rows, columns], reduce="amin")
    nearest = torch.where(nearest.isfinite(), nearest, torch.zeros_like(nearest))
    return nearest.view(height_px, width_px)
