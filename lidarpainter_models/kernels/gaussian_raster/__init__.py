"""Draw 3D Gaussians into an image and carry gradients back (Kerbl et al. 2023).

Gaussians live in *bodies*: body 0 is the street (the world frame), the others are actors in their
box frames; `camera_from_body` places each. The camera frame is x right, y down, z forward; lengths
are metres; the top-left pixel has its centre at (0.5, 0.5).
"""

from dataclasses import dataclass, fields

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from lidarpainter_models.errors import ShapeError
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.kernels.backends import Backend, implementation

DrawnImages = tuple[Tensor, Tensor, Tensor, Tensor, Tensor]
"""What a backend returns: the fields of `SplatImage`."""

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
            _check_tensor(field.name, getattr(self, field.name), expected[field.name], self.means)
        if coefficients not in SH_COEFFICIENTS:
            raise ShapeError(
                f"sh needs 1, 4, 9 or 16 coefficients in axis 1, got shape {tuple(self.sh.shape)}"
            )

    @property
    def learned(self) -> tuple[Tensor, ...]:
        """All floats, in order."""
        return self.means, self.rotation_wxyz, self.scale_m, self.opacity, self.sh

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


@dataclass(frozen=True, eq=False)
class SplatImage:
    """What the blended Gaussians show, and what densification needs to know about them.

    With a_i the alpha of the i-th Gaussian from the front and T_i the light that reaches it, each
    image is a sum over Gaussians of a_i T_i times the Gaussian's own value.
    """

    rgb: Float[Tensor, "height width 3"]
    """Colour, without background."""
    depth_m: Float[Tensor, "height width"]
    """Camera z of the Gaussians' centres; accumulated, not divided by alpha."""
    alpha: Float[Tensor, "height width"]
    """One minus the light that passes everything."""
    features: Float[Tensor, "height width features"]
    """The given features; zero channels if none were given."""
    visible: Bool[Tensor, " gaussians"]
    """Whether the Gaussian can reach any pixel; carries no gradient."""


def render_gaussians(
    splats: Splats,
    camera_from_body: Float[Tensor, "bodies 4 4"],
    camera: Camera,
    *,
    features: Float[Tensor, "gaussians features"] | None = None,
    screen_gradient_out: Float[Tensor, " gaussians"] | None = None,
    backend: Backend = "auto",
) -> SplatImage:
    """Blend Gaussians front to back.

    Gradients flow to every float tensor. A Gaussian whose centre is nearer than `NEAR_M`, or whose
    values are not finite, is left out; equal depths are drawn in the order of their index.

    Args:
        splats: the Gaussians.
        camera_from_body: rigid transforms of this view. They alone say where things stand.
        camera: its lens and the size of the image.
        features: further values to blend like colours.
        screen_gradient_out: overwritten by every backward pass with the length of
            (sum over pixels of |dL/dx|, of |dL/dy|), x and y being the projected centre in pixels
            (Ye et al. 2024, "AbsGS").
        backend: which implementation draws.

    Raises:
        ShapeError: the tensors do not belong together.
        BackendError: the backend cannot run here.
    """
    count, means = len(splats), splats.means
    if features is None:
        features = means.new_zeros((count, 0))
    channels = features.shape[1] if features.ndim == 2 else 0
    _check_tensor("features", features, (count, channels), means)
    bodies = camera_from_body.shape[0] if camera_from_body.ndim == 3 else 0
    _check_tensor("camera_from_body", camera_from_body, (bodies, 4, 4), means)
    splats.check_bodies(bodies)
    if screen_gradient_out is not None and screen_gradient_out.shape != (count,):
        raise ShapeError(
            f"the screen gradient needs a number for each of {count} Gaussians, got shape "
            f"{tuple(screen_gradient_out.shape)}"
        )
    draw = implementation("gaussian_raster", "draw_view", backend, means.device)
    return SplatImage(*draw(splats, features, camera_from_body, camera, screen_gradient_out))


def _check_tensor(name: str, value: Tensor, shape: tuple[int, ...], means: Tensor) -> None:
    """Refuse another shape or kind of numbers, or another device than the centres'."""
    if tuple(value.shape) != shape:
        raise ShapeError(f"{name} needs shape {shape}, got {tuple(value.shape)}")
    if value.is_floating_point() == (name == "body_index"):
        kind = "integers" if name == "body_index" else "floats"
        raise ShapeError(f"{name} needs {kind}, got {value.dtype}")
    if value.device != means.device:
        raise ShapeError(f"{name} is on {value.device}, means is on {means.device}")
