"""What every backend of the Gaussian rasteriser receives, checked once."""

import math
from dataclasses import dataclass, fields

import torch
from torch import Tensor

from lidarpainter_models.errors import ConfigError, ShapeError
from lidarpainter_models.kernels.gaussian_raster.blending_limits import BLUR_PX2, NEAR_M

DrawnImages = tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]
"""What a backend returns: rgb, depth, alpha, features, visible and radius, as in `SplatImage`."""

SH_COEFFICIENTS = (1, 4, 9, 16)
"""Number of spherical-harmonics coefficients for degree 0, 1, 2, 3."""


@dataclass(frozen=True, kw_only=True, eq=False)
class SplatInputs:
    """The tensors of some images; `render_views` says what each means and its shape.

    Raises:
        ShapeError: sizes or kinds of numbers do not belong together.
    """

    means: Tensor
    rotation_wxyz: Tensor
    scale_m: Tensor
    opacity: Tensor
    sh: Tensor
    body_index: Tensor
    camera_from_body: Tensor
    features: Tensor
    screen_offset: Tensor

    def __post_init__(self) -> None:
        """Check shapes, kinds, devices and the range of the body index."""
        count = self.means.shape[0] if self.means.ndim else 0
        coefficients = self.sh.shape[1] if self.sh.ndim == 3 else 0
        channels = self.features.shape[1] if self.features.ndim == 2 else 0
        views, bodies = (*self.camera_from_body.shape, 0, 0)[:2]
        expected = {
            "means": (count, 3),
            "rotation_wxyz": (count, 4),
            "scale_m": (count, 3),
            "opacity": (count,),
            "sh": (count, coefficients, 3),
            "body_index": (count,),
            "camera_from_body": (views, bodies, 4, 4),
            "features": (count, channels),
            "screen_offset": (views, count, 2),
        }
        for field in fields(self):
            _check_tensor(field.name, getattr(self, field.name), expected[field.name], self.means)
        if coefficients not in SH_COEFFICIENTS:
            raise ShapeError(
                f"sh needs 1, 4, 9 or 16 coefficients in axis 1, got shape {tuple(self.sh.shape)}"
            )
        self._check_bodies(bodies)

    def _check_bodies(self, bodies: int) -> None:
        if self.body_index.numel() == 0:
            return
        lowest, highest = (int(value) for value in torch.aminmax(self.body_index))
        if lowest < 0 or highest >= bodies:
            raise ShapeError(
                f"body_index runs from {lowest} to {highest}, but camera_from_body holds "
                f"{bodies} bodies"
            )


def _check_tensor(name: str, value: Tensor, shape: tuple[int, ...], means: Tensor) -> None:
    if tuple(value.shape) != shape:
        raise ShapeError(f"{name} needs shape {shape}, got {tuple(value.shape)}")
    if value.is_floating_point() == (name == "body_index"):
        kind = "integers" if name == "body_index" else "floats"
        raise ShapeError(f"{name} needs {kind}, got {value.dtype}")
    if value.device != means.device:
        raise ShapeError(f"{name} is on {value.device}, means is on {means.device}")


@dataclass(frozen=True, slots=True, kw_only=True)
class SplatView:
    """The pinhole camera of one image and how it is drawn.

    Raises:
        ConfigError: a value cannot be drawn with.
    """

    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float
    width_px: int
    height_px: int
    near_m: float = NEAR_M
    blur_px2: float = BLUR_PX2
    antialias: bool = False

    def __post_init__(self) -> None:
        """Refuse cameras that project nothing."""
        numbers = (self.fx_px, self.fy_px, self.cx_px, self.cy_px, self.near_m, self.blur_px2)
        if not all(math.isfinite(number) for number in numbers):
            raise ConfigError(f"a camera needs finite numbers, got {self}")
        if min(self.fx_px, self.fy_px) <= 0 or min(self.width_px, self.height_px) <= 0:
            raise ConfigError(
                f"a camera needs positive focal lengths and size, got fx {self.fx_px}, "
                f"fy {self.fy_px}, {self.width_px} x {self.height_px} px"
            )
        if self.near_m <= 0 or self.blur_px2 <= 0:
            raise ConfigError(
                f"near_m and blur_px2 must be positive, got {self.near_m} and {self.blur_px2}"
            )
