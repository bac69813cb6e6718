"""Draw 3D Gaussians into an image and carry gradients back (Kerbl et al. 2023).

Gaussians live in *bodies*: body 0 is the street (the world frame), the others are actors in their
box frames; `camera_from_body` places each. The camera frame is x right, y down, z forward; lengths
are metres; the top-left pixel has its centre at (0.5, 0.5).
"""

from collections.abc import Sequence
from dataclasses import dataclass

from jaxtyping import Bool, Float
from torch import Tensor

from lidarpainter_models.errors import ShapeError
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.kernels.backends import Backend, implementation
from lidarpainter_models.kernels.gaussian_raster.splats import Splats, check_tensor

__all__ = ["SplatImage", "Splats", "render_gaussians", "render_views"]


@dataclass(frozen=True, kw_only=True, eq=False)
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
    radius_px: Float[Tensor, " gaussians"]
    """Three standard deviations along the footprint's longer axis; 0 where not visible."""


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
    (image,) = render_views(
        splats,
        camera_from_body[None],
        [camera],
        features=features,
        screen_gradients_out=None if screen_gradient_out is None else screen_gradient_out[None],
        backend=backend,
    )
    return image


def render_views(
    splats: Splats,
    camera_from_body: Float[Tensor, "views bodies 4 4"],
    cameras: Sequence[Camera],
    *,
    features: Float[Tensor, "gaussians features"] | None = None,
    screen_gradients_out: Float[Tensor, "views gaussians"] | None = None,
    backend: Backend = "auto",
) -> list[SplatImage]:
    """`render_gaussians` for several cameras in one call; images may differ in size.

    Each image is that of a call of its own bit for bit (on a CPU), and a gradient is the sum over
    the views in their order. The Gaussians are checked once and gradients gathered in place.

    Raises:
        ShapeError: the tensors do not belong together.
        BackendError: the backend cannot run here.
    """
    means, count = splats.means, len(splats)
    if features is None:
        features = means.new_zeros((count, 0))
    channels = features.shape[1] if features.ndim == 2 else 0
    check_tensor("features", features, (count, channels), means)
    bodies = camera_from_body.shape[1] if camera_from_body.ndim == 4 else 0
    check_tensor("camera_from_body", camera_from_body, (len(cameras), bodies, 4, 4), means)
    splats.check_bodies(bodies)
    out = screen_gradients_out
    if out is not None and out.shape != (len(cameras), count):
        raise ShapeError(
            f"screen gradients need a number for each of {len(cameras)} views and {count} "
            f"Gaussians, got shape {tuple(out.shape)}"
        )
    if not cameras:
        return []
    draw = implementation("gaussian_raster", "draw_views", backend, means.device)
    return [
        SplatImage(
            rgb=rgb,
            depth_m=depth_m,
            alpha=alpha,
            features=feature_image,
            visible=visible,
            radius_px=radius_px,
        )
        for rgb, depth_m, alpha, feature_image, visible, radius_px in draw(
            splats, features, camera_from_body, tuple(cameras), out
        )
    ]
