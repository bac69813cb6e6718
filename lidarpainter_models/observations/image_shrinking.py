"""At which size a fit sees recorded images."""

from collections.abc import Iterable

import cv2
import torch
from jaxtyping import UInt8
from torch import Tensor

from lidarpainter_models.errors import ConfigError
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.observations.settings import ObservationConfig
from lidarpainter_models.scenes.records import RecordedView


def require_recorded_width(width_px: int, views: Iterable[RecordedView], what: str) -> None:
    """Refuse a width that was asked for and that no camera recorded.

    Raises:
        ConfigError: the widest of the images is narrower.
    """
    widest_px = max(view.camera.width_px for view in views)
    if width_px > widest_px:
        raise ConfigError(
            f"{what} {width_px} px: expected at most the {widest_px} px that were recorded, "
            "images are never enlarged"
        )


def shrink_image(
    rgb_u8: UInt8[Tensor, "height width 3"], *, width_px: int, height_px: int
) -> UInt8[Tensor, "rows columns 3"]:
    """Area-averaged copy of an image."""
    if rgb_u8.shape[:2] == (height_px, width_px):
        return rgb_u8
    small = cv2.resize(rgb_u8.numpy(), (width_px, height_px), interpolation=cv2.INTER_AREA)
    return torch.from_numpy(small)


def fit_camera(view: RecordedView, config: ObservationConfig) -> Camera:
    """The view's camera at fit size; images are never enlarged."""
    return view.camera.no_wider(config.width_px)
