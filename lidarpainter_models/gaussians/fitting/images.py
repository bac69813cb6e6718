"""Training images at full and half size, kept as bytes until a step of the fit asks for one."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from lidarpainter_models.devices import on_device
from lidarpainter_models.gaussians.model.sky import seen_as_sky
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.kernels.pixel_losses import NOTHING, OPEN, SKY, SOLID, PixelFacts
from lidarpainter_models.kernels.sky_texture import SkyLayout
from lidarpainter_models.observations.image_shrinking import shrink_image
from lidarpainter_models.observations.views import TrainingView

_BESIDE = np.ones((3, 3), np.uint8)


@dataclass(frozen=True, kw_only=True, eq=False)
class FitImage:
    """One training view at one size."""

    camera: Camera
    """The camera, posed as recorded."""
    timestamp_ns: int
    """When it was really taken."""
    camera_name: str
    rgb_u8: UInt8[Tensor, "height width 3"]
    kind: UInt8[Tensor, "height width"]
    """What each pixel shows, coded as in `PixelFacts`."""
    lidar_depth_m: Float[Tensor, "height width"]
    hidden: Bool[Tensor, "height width"] | None = None
    """Pixels that nothing is learnt from."""

    def to(self, device: torch.device) -> "FitImage":
        """Return the image on another device; itself if it is there."""
        return self if self.rgb_u8.device == device else on_device(self, device)

    def facts(self) -> PixelFacts:
        """Return what a step reads, made anew each time: floats take four times the memory."""
        return PixelFacts(
            rgb=self.rgb_u8.float() / 255, kind=self.kind, lidar_depth_m=self.lidar_depth_m
        )


def fit_images(
    views: Sequence[TrainingView], sky: SkyLayout, *, half_too: bool
) -> tuple[list[FitImage], list[FitImage]]:
    """The views' images, and those at half size if they are wanted; on the CPU.

    What lies in the direction of any image's sky mask may be sky in all of them.
    """
    cameras, masks = [view.camera for view in views], [view.sky_mask for view in views]
    # nothing below the horizon may be; a pixel of half the size reaches one pixel below it
    asked = [_grown(_above_horizon(camera)) for camera in cameras]
    pairs = list(zip(views, seen_as_sky(sky, cameras, masks, asked), strict=True))
    return [full_image(*pair) for pair in pairs], [half_image(*pair) for pair in pairs * half_too]


def full_image(
    view: TrainingView, may_be_sky: Bool[Tensor, "height width"] | None = None
) -> FitImage:
    """The view as it is; only pixels that may be sky can be OPEN, by default all."""
    return FitImage(
        camera=view.camera,
        timestamp_ns=view.camera.taken_ns(view.timestamp_ns),
        camera_name=view.key[1],
        rgb_u8=view.rgb_u8.contiguous(),
        kind=_kinds(view.camera, view.sky_mask, view.lidar_depth_m, may_be_sky),
        lidar_depth_m=view.lidar_depth_m.contiguous(),
        hidden=view.hidden,
    )


def half_image(
    view: TrainingView, may_be_sky: Bool[Tensor, "height width"] | None = None
) -> FitImage:
    """The view at half size: area-averaged colours, mostly-sky masks, nearest depths."""
    size = {
        "width_px": max(view.camera.width_px // 2, 1),
        "height_px": max(view.camera.height_px // 2, 1),
    }
    camera = view.camera.resized(**size)
    depth_m = shrink_depth(view.lidar_depth_m, **size)
    sky_mask = _shrink_mask(view.sky_mask, **size)
    may_be_sky = None if may_be_sky is None else _shrink_mask(may_be_sky, **size)
    return FitImage(
        camera=camera,
        timestamp_ns=view.camera.taken_ns(view.timestamp_ns),
        camera_name=view.key[1],
        rgb_u8=shrink_image(view.rgb_u8, **size).contiguous(),
        kind=_kinds(camera, sky_mask, depth_m, may_be_sky),
        lidar_depth_m=depth_m.contiguous(),
        hidden=None if view.hidden is None else _shrink_mask(view.hidden, **size, least=0.0),
    )


def shrink_depth(
    depth_m: Float[Tensor, "height width"], *, width_px: int, height_px: int
) -> Float[Tensor, "rows columns"]:
    """A sparse depth image on a coarser grid; the nearest depth of each cell wins."""
    rows, columns = depth_m.nonzero(as_tuple=True)
    cells = (rows * height_px // depth_m.shape[0]) * width_px
    cells = cells + columns * width_px // depth_m.shape[1]
    nearest = torch.full((height_px * width_px,), torch.inf)
    nearest.scatter_reduce_(0, cells, depth_m[rows, columns], reduce="amin")
    nearest = torch.where(nearest.isfinite(), nearest, torch.zeros_like(nearest))
    return nearest.view(height_px, width_px)


def _above_horizon(camera: Camera) -> Bool[Tensor, "height width"]:
    """Pixels whose rays rise, world z being up."""
    up = camera.world_from_camera[2, :3].float()
    u = (torch.arange(camera.width_px) + 0.5 - camera.cx_px) / camera.fx_px
    v = (torch.arange(camera.height_px) + 0.5 - camera.cy_px) / camera.fy_px
    return (up[1] * v)[:, None] + up[0] * u > -up[2]


def _grown(mask: Bool[Tensor, "height width"]) -> Bool[Tensor, "height width"]:
    """The mask and the pixels beside it, corner to corner too."""
    return torch.from_numpy(cv2.dilate(mask.numpy().view(np.uint8), _BESIDE)).bool()


def _shrink_mask(
    mask: Bool[Tensor, "height width"], *, width_px: int, height_px: int, least: float = 0.5
) -> Bool[Tensor, "rows columns"]:
    """True where more than that share of a cell of the coarser grid is."""
    share = cv2.resize(mask.float().numpy(), (width_px, height_px), interpolation=cv2.INTER_AREA)
    return torch.from_numpy(share) > least


def _kinds(
    camera: Camera,
    sky_mask: Bool[Tensor, "height width"],
    lidar_depth_m: Float[Tensor, "height width"],
    may_be_sky: Bool[Tensor, "height width"] | None,
) -> UInt8[Tensor, "height width"]:
    """Tell the pixels apart; solid ones are at most one pixel away from a LiDAR return."""
    is_open = _above_horizon(camera)
    if may_be_sky is not None:
        is_open &= may_be_sky
    kind = torch.full(sky_mask.shape, NOTHING, dtype=torch.uint8).masked_fill_(is_open, OPEN)
    return kind.masked_fill_(_grown(lidar_depth_m > 0), SOLID).masked_fill_(sky_mask, SKY)
