"""The rasteriser on an NVIDIA GPU: this project's projection, gsplat's tile rasteriser.

Projection, bodies and colour are those of the reference, in torch on the GPU, so that gradients
with respect to the transforms are exact; binning and blending are gsplat's kernels (Ye et al.
2024, "gsplat: An Open-Source Library for Gaussian Splatting"). gsplat 1.5 clamps alpha at 0.999
where the others clamp at 0.99, and its atomic sums make gradients differ in the last bits from run
to run. Only what can reach the picture is handed over, so memory follows the visible Gaussians, as
in gsplat's packed mode; antialiasing is in the opacity, depth is one of the blended values.
"""

from importlib import import_module
from types import ModuleType

import torch
from jaxtyping import Float
from torch import Tensor

from lidarpainter_models.errors import BackendError
from lidarpainter_models.kernels.gaussian_raster import reference
from lidarpainter_models.kernels.gaussian_raster.blending_limits import TILE_PX
from lidarpainter_models.kernels.gaussian_raster.reference import (
    ScreenGaussians,
    project_gaussians,
    screen_radii,
)
from lidarpainter_models.kernels.gaussian_raster.splat_inputs import (
    DrawnPictures,
    SplatInputs,
    SplatView,
)


def draw_gaussians(
    inputs: SplatInputs, view: SplatView, screen_gradient_out: Tensor | None
) -> DrawnPictures:
    """Picture as `SplatImage` lists it: rgb, depth, alpha, features, visible, radius.

    Raises:
        BackendError: gsplat or its kernels are missing, or the tensors are not on a CUDA device.
    """
    gsplat = import_gsplat()
    if inputs.means.device.type != "cuda":
        raise BackendError(
            f"the cuda backend needs tensors on a CUDA device, got {inputs.means.device}"
        )
    screen = project_gaussians(inputs, view)
    if len(screen.index) == 0:  # gsplat expects at least one
        return reference.draw_gaussians(inputs, view, screen_gradient_out)
    centre_px = screen.centre_px[None].contiguous()
    if screen_gradient_out is not None and centre_px.requires_grad:
        _report_screen_gradient(centre_px, screen.index, screen_gradient_out)
    tile_first, gaussian = _tile_lists(gsplat, screen, centre_px.detach(), view)
    precision = torch.linalg.inv(screen.covariance_px2)
    values, alpha = gsplat.rasterize_to_pixels(
        centre_px,
        torch.stack([precision[:, 0, 0], precision[:, 0, 1], precision[:, 1, 1]], dim=1)[None],
        screen.values[None],
        screen.opacity[None],
        view.width_px,
        view.height_px,
        TILE_PX,
        tile_first,
        gaussian,
        absgrad=screen_gradient_out is not None,
    )
    visible, radius_px = screen_radii(screen, len(inputs.means))
    picture = values[0]
    return picture[..., :3], picture[..., 3], alpha[0, ..., 0], picture[..., 4:], visible, radius_px


def import_gsplat() -> ModuleType:
    """Gsplat with kernels that can run; it compiles them here if no wheel brought them.

    Raises:
        BackendError: it is not installed, or there are no kernels and no compiler for them.
    """
    try:
        gsplat = import_module("gsplat")
    except ImportError as error:
        raise BackendError(
            f"the cuda backend needs gsplat ({error}); install the extra: "
            "pip install 'lidarpainter[cuda]'"
        ) from error
    try:
        kernels = import_module("gsplat.cuda._backend")._C
    except (ImportError, OSError, RuntimeError) as error:
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise BackendError(f"gsplat could not load or compile its kernels: {reason}") from error
    if kernels is None:
        raise BackendError(
            f"gsplat has no compiled kernels and finds no nvcc; install its wheel for torch "
            f"{torch.__version__} or a CUDA toolkit (CUDA_HOME)"
        )
    return gsplat


def _tile_lists(
    gsplat: ModuleType,
    screen: ScreenGaussians,
    centre_px: Float[Tensor, "1 visible 2"],
    view: SplatView,
) -> tuple[Tensor, Tensor]:
    """The first entry of each tile, as gsplat wants it, and the entries, nearest first."""
    columns = (view.width_px + TILE_PX - 1) // TILE_PX
    rows = (view.height_px + TILE_PX - 1) // TILE_PX
    radii_px = torch.ceil(screen.half_size_px.clamp_max(2.0**30)).to(torch.int32)
    _, tile_depth_keys, gaussian = gsplat.isect_tiles(
        centre_px,
        radii_px[None],
        screen.values[None, :, 3].detach().contiguous(),
        TILE_PX,
        columns,
        rows,
    )
    return gsplat.isect_offset_encode(tile_depth_keys, 1, columns, rows), gaussian


def _report_screen_gradient(
    centre_px: Float[Tensor, "1 visible 2"], index: Tensor, out: Float[Tensor, " gaussians"]
) -> None:
    """Copy gsplat's absolute gradient to `out` once the backward pass has found it."""
    watched = [centre_px]  # emptied by the first pass: a tensor held by its own hook never dies

    def report(gradient: Tensor) -> None:
        del gradient
        if watched:
            absolute = watched.pop().absgrad[0]  # type: ignore[attr-defined]  # gsplat adds it
            out.zero_()
            out[index] = torch.linalg.vector_norm(absolute, dim=1).to(out.dtype)

    centre_px.register_hook(report)
