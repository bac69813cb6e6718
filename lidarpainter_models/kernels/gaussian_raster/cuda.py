"""The rasteriser on an NVIDIA GPU: this project's projection, gsplat's tile rasteriser.

Projection, bodies and colour are those of the reference, in torch on the GPU, so that gradients
with respect to the transforms are exact; binning and blending are gsplat's kernels (Ye et al.
2024, "gsplat: An Open-Source Library for Gaussian Splatting"). gsplat 1.5 clamps alpha at 0.999
where the others clamp at 0.99, and its atomic sums make gradients differ in the last bits from run
to run. Only what can reach the image is handed over, in gsplat's packed form, so memory follows the
visible Gaussians; depth is one of the blended values.
"""

from types import ModuleType

import torch
from jaxtyping import Float
from torch import Tensor

from lidarpainter_models.errors import BackendError
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.kernels.gaussian_raster import DrawnImages, Splats
from lidarpainter_models.kernels.gaussian_raster.blending_limits import TILE_PX
from lidarpainter_models.kernels.gaussian_raster.reference import (
    ScreenGaussians,
    are_visible,
    project_gaussians,
)
from lidarpainter_models.kernels.gpu_packages import import_gsplat


def draw_view(
    splats: Splats,
    features: Float[Tensor, "gaussians features"],
    camera_from_body: Float[Tensor, "bodies 4 4"],
    camera: Camera,
    screen_gradient_out: Float[Tensor, " gaussians"] | None,
) -> DrawnImages:
    """Images as `SplatImage` lists them.

    Raises:
        BackendError: gsplat or its kernels are missing, or the tensors are not on a CUDA device.
    """
    gsplat = import_gsplat()
    if splats.means.device.type != "cuda":
        raise BackendError(
            f"the cuda backend needs tensors on a CUDA device, got {splats.means.device}"
        )
    return draw_with(gsplat, splats, features, camera_from_body, camera, screen_gradient_out)


def draw_with(
    gsplat: ModuleType,
    splats: Splats,
    features: Float[Tensor, "gaussians features"],
    camera_from_body: Float[Tensor, "bodies 4 4"],
    camera: Camera,
    screen_gradient_out: Float[Tensor, " gaussians"] | None,
) -> DrawnImages:
    """Draw with gsplat's functions on any device that they take."""
    if screen_gradient_out is not None:
        screen_gradient_out.zero_()
    screen = project_gaussians(splats, features, camera_from_body, camera)
    values, alpha = _rasterised(gsplat, screen, camera, screen_gradient_out)
    visible = are_visible(screen, len(splats))
    return values[..., :3], values[..., 3], alpha, values[..., 4:], visible


def _rasterised(
    gsplat: ModuleType, screen: ScreenGaussians, view: Camera, screen_gradient_out: Tensor | None
) -> tuple[Float[Tensor, "height width channels"], Float[Tensor, "height width"]]:
    """Blended values and alpha."""
    values, opacity = screen.values, screen.opacity
    precision = torch.linalg.inv(screen.covariance_px2)
    conics = torch.stack([precision[:, 0, 0], precision[:, 0, 1], precision[:, 1, 1]], dim=1)
    if len(values) == 0:  # gsplat expects at least one
        nothing = sum(tensor.sum() for tensor in (values, conics, opacity, screen.centre_px))
        blank = nothing + values.new_zeros((view.height_px, view.width_px, values.shape[1]))
        return blank, blank[..., 0]
    centre_px = screen.centre_px.contiguous()
    is_watched = screen_gradient_out is not None and centre_px.requires_grad
    if screen_gradient_out is not None and is_watched:
        _report_screen_gradient(centre_px, screen, screen_gradient_out)
    tile_first, gaussian = _tile_lists(gsplat, screen, centre_px.detach(), view)
    images, alpha = gsplat.rasterize_to_pixels(
        centre_px,
        conics,
        values,
        opacity,
        view.width_px,
        view.height_px,
        TILE_PX,
        tile_first,
        gaussian,
        packed=True,
        absgrad=is_watched,
    )
    return images[0], alpha[0, ..., 0]


def _tile_lists(
    gsplat: ModuleType, screen: ScreenGaussians, centre_px: Tensor, view: Camera
) -> tuple[Tensor, Tensor]:
    """The first entry of each tile, as gsplat wants it, and the entries, nearest first."""
    columns = (view.width_px + TILE_PX - 1) // TILE_PX
    rows = (view.height_px + TILE_PX - 1) // TILE_PX
    radii_px = torch.ceil(screen.half_size_px.clamp_max(2.0**30)).to(torch.int32)
    depth_m = screen.values[:, 3].detach().contiguous()
    _, tile_depth_keys, gaussian = gsplat.isect_tiles(
        centre_px,
        radii_px,
        depth_m,
        TILE_PX,
        columns,
        rows,
        packed=True,
        n_images=1,
        image_ids=torch.zeros_like(screen.index),
        gaussian_ids=screen.index,
    )
    return gsplat.isect_offset_encode(tile_depth_keys, 1, columns, rows), gaussian


def _report_screen_gradient(
    centre_px: Tensor, screen: ScreenGaussians, out: Float[Tensor, " gaussians"]
) -> None:
    """Copy gsplat's absolute gradients once a backward pass has found them."""
    watched = [centre_px]  # emptied by the first pass: a tensor held by its own hook never dies

    def report(gradient: Tensor) -> None:
        del gradient
        if not watched:
            return
        absolute = watched.pop().absgrad.reshape(-1, 2)  # type: ignore[attr-defined]  # gsplat adds it
        out.zero_()
        out[screen.index] = torch.linalg.vector_norm(absolute, dim=1).to(out.dtype)

    centre_px.register_hook(report)
