"""Draw 3D Gaussians into an image and carry gradients back (Kerbl et al. 2023).

Gaussians live in *bodies*: body 0 is the street (the world frame), the others are actors in their
box frames; `camera_from_body` places each. The camera frame is x right, y down, z forward; lengths
are metres; the top-left pixel has its centre at (0.5, 0.5).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from lidarpainter_models.errors import ShapeError
from lidarpainter_models.kernels.backends import Backend, chosen_backend, implementation
from lidarpainter_models.kernels.gaussian_raster.blending_limits import BLUR_PX2, NEAR_M
from lidarpainter_models.kernels.gaussian_raster.splat_inputs import SplatInputs, SplatView

__all__ = [
    "SplatImage",
    "SplatView",
    "accumulate_pixel_error",
    "render_gaussians",
    "render_views",
]


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


def render_gaussians(  # noqa: PLR0913 - the one door to the kernel; the scalars are the camera
    means: Float[Tensor, "gaussians 3"],
    rotation_wxyz: Float[Tensor, "gaussians 4"],
    scale_m: Float[Tensor, "gaussians 3"],
    opacity: Float[Tensor, " gaussians"],
    sh: Float[Tensor, "gaussians coefficients 3"],
    body_index: Int[Tensor, " gaussians"],
    camera_from_body: Float[Tensor, "bodies 4 4"],
    *,
    fx_px: float,
    fy_px: float,
    cx_px: float,
    cy_px: float,
    width_px: int,
    height_px: int,
    features: Float[Tensor, "gaussians features"] | None = None,
    near_m: float = NEAR_M,
    blur_px2: float = BLUR_PX2,
    antialias: bool = False,
    screen_offset: Float[Tensor, "gaussians 2"] | None = None,
    screen_gradient_out: Float[Tensor, " gaussians"] | None = None,
    backend: Backend = "auto",
) -> SplatImage:
    """Blend Gaussians front to back.

    Gradients flow to every float tensor. A Gaussian whose centre is nearer than `near_m`, or whose
    values are not finite, is left out; equal depths are drawn in the order of their index.

    Args:
        means: centres in the frame of the Gaussian's body, metres.
        rotation_wxyz: body-from-Gaussian rotation as a quaternion of any length above zero.
        scale_m: standard deviations along the Gaussian's own axes, above zero.
        opacity: 0 to 1.
        sh: spherical harmonics of degree 0 to 3 (1, 4, 9 or 16 coefficients), in the order and
            signs of Kerbl et al.; colour is 0.5 plus their sum, not under 0. The direction runs
            from the camera to the centre, in the frame of the body.
        body_index: which body a Gaussian belongs to.
        camera_from_body: rigid transforms of this view.
        fx_px: focal length; with `fy_px`, `cx_px`, `cy_px` a pinhole camera.
        fy_px: see `fx_px`.
        cx_px: principal point from the image's left edge.
        cy_px: principal point from the image's top edge.
        width_px: size of the image.
        height_px: size of the image.
        features: further values to blend like colours.
        near_m: Gaussians with a smaller camera z are not drawn.
        blur_px2: added to the variance of every footprint, so that none is thinner than a pixel.
        antialias: dim a Gaussian by what `blur_px2` widened it (Yu et al. 2024, "Mip-Splatting").
        screen_offset: added to the projected centres, pixels; a leaf of zeros receives the
            gradient with respect to them.
        screen_gradient_out: overwritten by every backward pass with the length of
            (sum over pixels of |dL/dx|, of |dL/dy|), x and y being the projected centre in pixels
            (Ye et al. 2024, "AbsGS").
        backend: which implementation draws.

    Raises:
        ShapeError: the tensors do not belong together.
        ConfigError: the camera or a setting makes no sense.
        BackendError: the backend cannot run here.
    """
    view = SplatView(
        fx_px=float(fx_px),
        fy_px=float(fy_px),
        cx_px=float(cx_px),
        cy_px=float(cy_px),
        width_px=int(width_px),
        height_px=int(height_px),
        near_m=float(near_m),
        blur_px2=float(blur_px2),
        antialias=bool(antialias),
    )
    if screen_gradient_out is not None and screen_gradient_out.shape != means.shape[:1]:
        raise ShapeError(
            f"screen_gradient_out needs shape {tuple(means.shape[:1])}, got "
            f"{tuple(screen_gradient_out.shape)}"
        )
    (image,) = render_views(
        means,
        rotation_wxyz,
        scale_m,
        opacity,
        sh,
        body_index,
        camera_from_body[None],
        [view],
        features=features,
        screen_offsets=None if screen_offset is None else screen_offset[None],
        screen_gradients_out=None if screen_gradient_out is None else screen_gradient_out[None],
        backend=backend,
    )
    return image


def render_views(  # noqa: PLR0913 - the Gaussians, and what differs from view to view
    means: Float[Tensor, "gaussians 3"],
    rotation_wxyz: Float[Tensor, "gaussians 4"],
    scale_m: Float[Tensor, "gaussians 3"],
    opacity: Float[Tensor, " gaussians"],
    sh: Float[Tensor, "gaussians coefficients 3"],
    body_index: Int[Tensor, " gaussians"],
    camera_from_body: Float[Tensor, "views bodies 4 4"],
    views: Sequence[SplatView],
    *,
    features: Float[Tensor, "gaussians features"] | None = None,
    screen_offsets: Float[Tensor, "views gaussians 2"] | None = None,
    screen_gradients_out: Float[Tensor, "views gaussians"] | None = None,
    backend: Backend = "auto",
    packed: bool = True,
) -> list[SplatImage]:
    """`render_gaussians` for several cameras in one call; images may differ in size.

    Each image is that of a call of its own bit for bit (on a CPU), and a gradient is the sum over
    the views in their order. The Gaussians are checked once and gradients gathered in place.

    Args:
        means: with the next five as in `render_gaussians`.
        rotation_wxyz: see `means`.
        scale_m: see `means`.
        opacity: see `means`.
        sh: see `means`.
        body_index: see `means`.
        camera_from_body: rigid transforms of each view.
        views: the cameras.
        features: as in `render_gaussians`.
        screen_offsets: as there, per view.
        screen_gradients_out: as there, per view.
        backend: as there.
        packed: on CUDA, hand all views of one size to gsplat in one call, as the list of what is
            visible in each; otherwise view by view. Nothing else depends on it.

    Raises:
        ShapeError: the tensors do not belong together.
        ConfigError: a camera or a setting makes no sense.
        BackendError: the backend cannot run here.
    """
    count, num_views = means.shape[0], (*camera_from_body.shape, 0)[0]
    inputs = SplatInputs(
        means=means,
        rotation_wxyz=rotation_wxyz,
        scale_m=scale_m,
        opacity=opacity,
        sh=sh,
        body_index=body_index,
        camera_from_body=camera_from_body,
        features=means.new_zeros((count, 0)) if features is None else features,
        screen_offset=(
            means.new_zeros((num_views, count, 2)) if screen_offsets is None else screen_offsets
        ),
    )
    if len(views) != num_views:
        raise ShapeError(
            f"camera_from_body holds {num_views} views, but {len(views)} cameras are given"
        )
    out = screen_gradients_out
    if out is not None and out.shape != (num_views, count):
        raise ShapeError(
            f"screen_gradients_out needs shape ({num_views}, {count}), got {tuple(out.shape)}"
        )
    if not views:
        return []
    draw = implementation("gaussian_raster", "draw_views", backend, means.device)
    if chosen_backend(backend, means.device) == "cuda":
        draw = partial(draw, packed=packed)
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
            inputs, tuple(views), screen_gradients_out
        )
    ]


def accumulate_pixel_error(
    pixel_error: Float[Tensor, "height width"],
    *gaussians: Tensor,
    **camera: Any,  # noqa: ANN401 - passed on
) -> Float[Tensor, " gaussians"]:
    """How much of an image's error each Gaussian drew: the sum over pixels of a_i T_i error.

    Where it is large, the scene needs more Gaussians (Bulo et al. 2024, "Revising Densification
    in Gaussian Splatting"). It is the gradient of a blended feature, so a training step that
    already draws and goes back gets it almost for free with a feature channel of its own: give
    zeros that require a gradient as `features` and add `(image.features[..., 0] * error).sum()` to
    the loss.

    Args:
        pixel_error: error of the drawn image.
        gaussians: positional arguments of `render_gaussians`.
        camera: keyword arguments of `render_gaussians` other than `features`.
    """
    share = pixel_error.new_zeros((len(gaussians[0]), 1), requires_grad=True)
    with torch.enable_grad():
        image = render_gaussians(
            *(tensor.detach() for tensor in gaussians), features=share, **camera
        )
        (sums,) = torch.autograd.grad(image.features[..., 0], share, pixel_error.detach())
    return sums[:, 0]
