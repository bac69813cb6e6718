"""What every backend of the Gaussian rasteriser receives, checked once."""

from dataclasses import dataclass, fields

import torch
from torch import Tensor

from lidarpainter_models.errors import ShapeError

DrawnImages = tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]
"""What a backend returns: rgb, depth, alpha, features, visible and radius, as in `SplatImage`."""

SH_COEFFICIENTS = (1, 4, 9, 16)
"""Number of spherical-harmonics coefficients for degree 0, 1, 2, 3."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Splats:
    """Gaussians as they are drawn, row by row; gradients flow to every float tensor.

    Shapes are checked here and so stand in words.

    Raises:
        ShapeError: sizes, kinds of numbers or devices do not belong together.
    """

    means: Tensor
    """(gaussians, 3): centres in the frame of the Gaussian's body, metres."""
    rotation_wxyz: Tensor
    """(gaussians, 4): body-from-Gaussian rotation as a quaternion of any length above zero."""
    scale_m: Tensor
    """(gaussians, 3): standard deviations along the Gaussian's own axes, above zero."""
    opacity: Tensor
    """(gaussians): 0 to 1."""
    sh: Tensor
    """(gaussians, coefficients, 3): spherical harmonics of degree 0 to 3 (1, 4, 9 or 16
    coefficients), in the order and signs of Kerbl et al.; colour is 0.5 plus their sum, not under
    0. The direction runs from the camera to the centre, in the frame of the body."""
    body_index: Tensor
    """(gaussians), integers: which body a Gaussian belongs to."""

    def __post_init__(self) -> None:
        """Check shapes, kinds and devices."""
        count = len(self)
        coefficients = self.sh.shape[1] if self.sh.ndim == 3 else 0
        expected = {
            "means": (count, 3),
            "rotation_wxyz": (count, 4),
            "scale_m": (count, 3),
            "opacity": (count,),
            "sh": (count, coefficients, 3),
            "body_index": (count,),
        }
        for field in fields(self):
            check_tensor(field.name, getattr(self, field.name), expected[field.name], self.means)
        if coefficients not in SH_COEFFICIENTS:
            raise ShapeError(
                f"sh needs 1, 4, 9 or 16 coefficients in axis 1, got shape {tuple(self.sh.shape)}"
            )

    def __len__(self) -> int:
        return self.means.shape[0] if self.means.ndim else 0

    def check_bodies(self, bodies: int) -> None:
        """Refuse Gaussians of other bodies than the first so many.

        Raises:
            ShapeError: there are such.
        """
        if len(self) == 0:
            return
        # together, so that a GPU is waited for once
        lowest, highest = torch.stack(torch.aminmax(self.body_index)).tolist()
        if lowest < 0 or highest >= bodies:
            raise ShapeError(
                f"body_index runs from {lowest} to {highest}, but camera_from_body holds "
                f"{bodies} bodies"
            )


def check_tensor(name: str, value: Tensor, shape: tuple[int, ...], means: Tensor) -> None:
    """Refuse another shape or kind of numbers, or another device than the centres'.

    Raises:
        ShapeError: it is not as it must be.
    """
    if tuple(value.shape) != shape:
        raise ShapeError(f"{name} needs shape {shape}, got {tuple(value.shape)}")
    if value.is_floating_point() == (name == "body_index"):
        kind = "integers" if name == "body_index" else "floats"
        raise ShapeError(f"{name} needs {kind}, got {value.dtype}")
    if value.device != means.device:
        raise ShapeError(f"{name} is on {value.device}, means is on {means.device}")
