"""The rasteriser on an NVIDIA GPU: this project's projection, gsplat's tile rasteriser.

Projection, bodies and colour are those of the reference, in torch on the GPU, so that gradients
with respect to the transforms are exact; binning and blending are gsplat's kernels (Ye et al.
2024, "gsplat: An Open-Source Library for Gaussian Splatting"). gsplat 1.5 clamps alpha at 0.999
where the others clamp at 0.99, and its atomic sums make gradients differ in the last bits from run
to run. Only what can reach an image is handed over, so memory follows the visible Gaussians, and
views of one size go in one call in gsplat's packed form; depth is one of the blended values.
"""

from collections.abc import Sequence
from types import ModuleType

import torch
from jaxtyping import Float
from torch import Tensor

from lidarpainter_models.errors import BackendError
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.kernels.gaussian_raster.blending_limits import TILE_PX
from lidarpainter_models.kernels.gaussian_raster.reference import (
    ScreenGaussians,
    project_gaussians,
    screen_radii,
)
from lidarpainter_models.kernels.gaussian_raster.splats import DrawnImages, Splats
from lidarpainter_models.kernels.gpu_packages import import_gsplat


def draw_views(
    splats: Splats,
    features: Float[Tensor, "gaussians features"],
    camera_from_body: Float[Tensor, "views bodies 4 4"],
    cameras: Sequence[Camera],
    screen_gradients_out: Float[Tensor, "views gaussians"] | None,
) -> list[DrawnImages]:
    """Images as `SplatImage` lists them: rgb, depth, alpha, features, visible, radius.

    Raises:
        BackendError: gsplat or its kernels are missing, or the tensors are not on a CUDA device.
    """
    gsplat = import_gsplat()
    if splats.means.device.type != "cuda":
        raise BackendError(
            f"the cuda backend needs tensors on a CUDA device, got {splats.means.device}"
        )
    return draw_with(gsplat, splats, features, camera_from_body, cameras, screen_gradients_out)


def draw_with(
    gsplat: ModuleType,
    splats: Splats,
    features: Float[Tensor, "gaussians features"],
    camera_from_body: Float[Tensor, "views bodies 4 4"],
    cameras: Sequence[Camera],
    screen_gradients_out: Float[Tensor, "views gaussians"] | None,
) -> list[DrawnImages]:
    """Draw with gsplat's functions on any device that they take."""
    if screen_gradients_out is not None:
        screen_gradients_out.zero_()
    groups: dict[tuple[int, int], list[int]] = {}
    for place, camera in enumerate(cameras):
        groups.setdefault((camera.width_px, camera.height_px), []).append(place)
    drawn: dict[int, DrawnImages] = {}
    for places in groups.values():
        screens = [
            project_gaussians(splats, features, camera_from_body[place], cameras[place])
            for place in places
        ]
        images = _rasterised(gsplat, screens, cameras[places[0]], places, screen_gradients_out)
        for place, screen, (values, alpha) in zip(places, screens, images, strict=True):
            seen = screen_radii(screen, len(splats))
            drawn[place] = (values[..., :3], values[..., 3], alpha, values[..., 4:], *seen)
    return [drawn[place] for place in range(len(cameras))]


def _rasterised(
    gsplat: ModuleType,
    screens: list[ScreenGaussians],
    view: Camera,
    places: list[int],
    screen_gradients_out: Tensor | None,
) -> list[tuple[Float[Tensor, "height width channels"], Float[Tensor, "height width"]]]:
    """Values and alpha of views of one size.

    Gsplat gets the visible Gaussians of all views in one list and the view of each.
    """
    values = torch.cat([screen.values for screen in screens])
    size = (view.height_px, view.width_px)
    precision = torch.linalg.inv(torch.cat([screen.covariance_px2 for screen in screens]))
    conics = torch.stack([precision[:, 0, 0], precision[:, 0, 1], precision[:, 1, 1]], dim=1)
    opacity = torch.cat([screen.opacity for screen in screens])
    centre_px = torch.cat([screen.centre_px for screen in screens])
    if len(values) == 0:  # gsplat expects at least one
        nothing = sum(tensor.sum() for tensor in (values, conics, opacity, centre_px))
        blank = nothing + values.new_zeros((len(screens), *size, values.shape[1]))
        return [(image, image[..., 0]) for image in blank]
    centre_px = centre_px.contiguous()
    is_watched = screen_gradients_out is not None and centre_px.requires_grad
    if screen_gradients_out is not None and is_watched:
        _report_screen_gradient(centre_px, screens, places, screen_gradients_out)
    tile_first, gaussian = _tile_lists(gsplat, screens, centre_px.detach(), view)
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
    return list(zip(images, alpha[..., 0], strict=True))


def _tile_lists(
    gsplat: ModuleType,
    screens: list[ScreenGaussians],
    centre_px: Tensor,
    view: Camera,
) -> tuple[Tensor, Tensor]:
    """The first entry of each tile, as gsplat wants it, and the entries, nearest first."""
    columns = (view.width_px + TILE_PX - 1) // TILE_PX
    rows = (view.height_px + TILE_PX - 1) // TILE_PX
    half_size_px = torch.cat([screen.half_size_px for screen in screens])
    radii_px = torch.ceil(half_size_px.clamp_max(2.0**30)).to(torch.int32)
    depth_m = torch.cat([screen.values[:, 3] for screen in screens]).detach().contiguous()
    counts = torch.tensor([len(screen.index) for screen in screens], device=depth_m.device)
    images = torch.arange(len(screens), device=depth_m.device)
    _, tile_depth_keys, gaussian = gsplat.isect_tiles(
        centre_px,
        radii_px,
        depth_m,
        TILE_PX,
        columns,
        rows,
        packed=True,
        n_images=len(screens),
        image_ids=torch.repeat_interleave(images, counts),
        gaussian_ids=torch.cat([screen.index for screen in screens]),
    )
    return gsplat.isect_offset_encode(tile_depth_keys, len(screens), columns, rows), gaussian


def _report_screen_gradient(
    centre_px: Tensor,
    screens: list[ScreenGaussians],
    places: list[int],
    out: Float[Tensor, "views gaussians"],
) -> None:
    """Copy gsplat's absolute gradients to the views' rows once a backward pass has found them."""
    watched = [centre_px]  # emptied by the first pass: a tensor held by its own hook never dies

    def report(gradient: Tensor) -> None:
        del gradient
        if not watched:
            return
        absolute = watched.pop().absgrad.reshape(-1, 2)  # type: ignore[attr-defined]  # gsplat adds it
        lengths = torch.linalg.vector_norm(absolute, dim=1).to(out.dtype)
        parts = lengths.split([len(screen.index) for screen in screens])
        for place, screen, part in zip(places, screens, parts, strict=True):
            out[place] = 0
            out[place, screen.index] = part

    centre_px.register_hook(report)
