"""The rasteriser in plain torch: the law for the other backends.

Any float type (float64 if asked), any device, gradients by autograd. Projection after Zwicker et
al. (2001), "EWA splatting", blending after Kerbl et al. (2023); `blending_limits` holds the
constants. Gaussians that cannot reach a tile are left out of it, which changes no value.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.geometry.transforms import rotation_from_quaternion
from lidarpainter_models.kernels.gaussian_raster import DrawnImages, Splats
from lidarpainter_models.kernels.gaussian_raster.blending_limits import (
    ALPHA_CUT,
    BLUR_PX2,
    COLOUR_OFFSET,
    MAX_ALPHA,
    MIN_TRANSMITTANCE,
    NEAR_M,
    TILE_PX,
    linear_tangents,
)


@dataclass(frozen=True, kw_only=True, eq=False)
class ScreenGaussians:
    """Gaussians on the screen, nearest first; only those that may be seen."""

    index: Tensor
    centre_px: Float[Tensor, "visible 2"]
    covariance_px2: Float[Tensor, "visible 2 2"]
    """Blurred."""
    opacity: Float[Tensor, " visible"]
    values: Float[Tensor, "visible channels"]
    """Red, green, blue, depth and features."""
    half_size_px: Float[Tensor, "visible 2"]
    """Half width and height of the region where alpha reaches `ALPHA_CUT`; no gradient."""


def draw_view(
    splats: Splats,
    features: Float[Tensor, "gaussians features"],
    camera_from_body: Float[Tensor, "bodies 4 4"],
    camera: Camera,
    screen_gradient_out: Float[Tensor, " gaussians"] | None,
) -> DrawnImages:
    """Images as `SplatImage` lists them."""
    screen = project_gaussians(splats, features, camera_from_body, camera)
    watch = None
    if screen_gradient_out is not None:
        watch = ScreenGradientWatch(screen.index, screen_gradient_out)
    rows = []
    for top in range(0, camera.height_px, TILE_PX):
        columns = range(0, camera.width_px, TILE_PX)
        tiles = [_draw_tile(screen, left, top, camera, watch) for left in columns]
        rows.append(torch.cat(tiles, dim=1))
    image = torch.cat(rows, dim=0)
    if watch is not None and image.requires_grad:
        image.register_hook(watch.restart)
    alpha, values = image[..., 0], image[..., 1:]
    visible = are_visible(screen, len(splats))
    return values[..., :3], values[..., 3], alpha, values[..., 4:], visible


def project_gaussians(
    splats: Splats,
    features: Float[Tensor, "gaussians features"],
    camera_from_body: Float[Tensor, "bodies 4 4"],
    view: Camera,
) -> ScreenGaussians:
    """Project into a view, drop what no pixel can see, and sort by depth."""
    camera_from_own = camera_from_body.to(splats.means)[splats.body_index.long()]
    rotation, translation = camera_from_own[:, :3, :3], camera_from_own[:, :3, 3]
    point = torch.einsum("gij,gj->gi", rotation, splats.means) + translation
    kept = torch.nonzero((point[:, 2] >= NEAR_M) & (splats.opacity >= ALPHA_CUT))[:, 0]
    # stable: equal depths keep the order of their index
    kept = kept[torch.sort(point[kept, 2].detach(), stable=True).indices]
    point, rotation, translation = point[kept], rotation[kept], translation[kept]
    bare = _screen_covariance(splats, kept, point, rotation, view)
    covariance = bare + BLUR_PX2 * torch.eye(2).to(bare)
    opacity = splats.opacity[kept]
    focal = point.new_tensor([view.fx_px, view.fy_px])
    principal = point.new_tensor([view.cx_px, view.cy_px])
    centre = focal * point[:, :2] / point[:, 2:] + principal
    colour = _colour(splats, kept, rotation, translation)
    values = torch.cat([colour, point[:, 2:], features[kept]], dim=1)
    return _seen(
        ScreenGaussians(
            index=kept,
            centre_px=centre,
            covariance_px2=covariance,
            opacity=opacity,
            values=values,
            half_size_px=_half_size(covariance.detach(), opacity.detach()),
        ),
        view,
    )


def are_visible(screen: ScreenGaussians, count: int) -> Bool[Tensor, " gaussians"]:
    """Which of all Gaussians are on the screen."""
    visible = torch.zeros(count, dtype=torch.bool, device=screen.index.device)
    visible[screen.index] = True
    return visible


def _screen_covariance(
    splats: Splats,
    kept: Tensor,
    point: Float[Tensor, "visible 3"],
    rotation: Float[Tensor, "visible 3 3"],
    view: Camera,
) -> Float[Tensor, "visible 2 2"]:
    """J W S W^T J^T before blurring; J is taken at a tangent not far outside the image."""
    turned = rotation @ rotation_from_quaternion(splats.rotation_wxyz[kept])
    axes = turned * splats.scale_m[kept, None]
    z = point[:, 2]
    lowest_x, highest_x, lowest_y, highest_y = linear_tangents(view)
    tangent_x = (point[:, 0] / z).clamp(lowest_x, highest_x)
    tangent_y = (point[:, 1] / z).clamp(lowest_y, highest_y)
    row_x = (axes[:, 0] - tangent_x[:, None] * axes[:, 2]) * (view.fx_px / z)[:, None]
    row_y = (axes[:, 1] - tangent_y[:, None] * axes[:, 2]) * (view.fy_px / z)[:, None]
    rows = torch.stack([row_x, row_y], dim=1)
    return rows @ rows.transpose(1, 2)


def _colour(
    splats: Splats,
    kept: Tensor,
    rotation: Float[Tensor, "visible 3 3"],
    translation: Float[Tensor, "visible 3"],
) -> Float[Tensor, "visible 3"]:
    camera_in_body = -torch.einsum("gji,gj->gi", rotation, translation)
    direction = torch.nn.functional.normalize(splats.means[kept] - camera_in_body, dim=1)
    basis = harmonic_basis(direction, splats.sh.shape[1])
    return torch.relu(COLOUR_OFFSET + torch.einsum("gk,gkc->gc", basis, splats.sh[kept]))


def _half_size(
    covariance: Float[Tensor, "visible 2 2"], opacity: Float[Tensor, " visible"]
) -> Float[Tensor, "visible 2"]:
    reach = 2.0 * (torch.log(opacity) - math.log(ALPHA_CUT))
    return (reach[:, None] * torch.diagonal(covariance, dim1=1, dim2=2)).sqrt()


def _seen(screen: ScreenGaussians, view: Camera) -> ScreenGaussians:
    """Those whose region reaches a pixel centre; a value that is not finite fails."""
    centre, half = screen.centre_px.detach(), screen.half_size_px
    highest = centre.new_tensor([view.width_px - 0.5, view.height_px - 0.5])
    reaches = ((centre + half >= 0.5) & (centre - half <= highest)).all(dim=1)
    finite = torch.linalg.det(screen.covariance_px2.detach()) > 0
    finite &= torch.isfinite(screen.values[:, :4].detach()).all(dim=1)
    finite &= torch.isfinite(half).all(dim=1)
    kept = torch.nonzero(reaches & finite & (screen.opacity.detach() >= ALPHA_CUT))[:, 0]
    return _chosen(screen, kept)


def _chosen(screen: ScreenGaussians, kept: Tensor) -> ScreenGaussians:
    return ScreenGaussians(**{name: column[kept] for name, column in vars(screen).items()})


class ScreenGradientWatch:
    """Adds up |dL/dx| and |dL/dy| over pixels while a backward pass runs ("absgrad")."""

    def __init__(self, index: Tensor, out: Tensor) -> None:
        self._index, self._out = index, out
        self._sums = out.new_zeros((len(index), 2))

    def restart(self, gradient: Tensor) -> None:
        """Forget the last pass; called with the image's gradient before any other."""
        del gradient
        self._sums.zero_()
        self._out.zero_()

    def add(self, kept: Tensor, gradient: Float[Tensor, "pixels chosen 2"]) -> None:
        """Add one tile's gradients of the centre, pixel by pixel."""
        self._sums.index_add_(0, kept, gradient.abs().sum(dim=0).to(self._sums))
        self._out[self._index] = torch.linalg.vector_norm(self._sums, dim=1)


def _draw_tile(
    screen: ScreenGaussians, left: int, top: int, view: Camera, watch: ScreenGradientWatch | None
) -> Float[Tensor, "rows columns channels"]:
    """Alpha and blended values of one tile."""
    rows, columns = min(TILE_PX, view.height_px - top), min(TILE_PX, view.width_px - left)
    low = screen.half_size_px.new_tensor([left, top])
    size = screen.half_size_px.new_tensor([columns, rows])
    centre, half = screen.centre_px.detach(), screen.half_size_px
    touches = ((centre + half >= low) & (centre - half <= low + size)).all(dim=1)
    kept = torch.nonzero(touches)[:, 0]
    chosen = _chosen(screen, kept)
    y, x = torch.meshgrid(
        torch.arange(rows).to(low) + 0.5 + top,
        torch.arange(columns).to(low) + 0.5 + left,
        indexing="ij",
    )
    pixel_px = torch.stack([x, y], dim=-1).reshape(-1, 1, 2)
    centre_px = chosen.centre_px[None].expand(len(pixel_px), -1, -1)
    if watch is not None and centre_px.requires_grad:
        centre_px.register_hook(lambda gradient: watch.add(kept, gradient))
    return _blended(chosen, pixel_px - centre_px).reshape(rows, columns, -1)


def _blended(
    chosen: ScreenGaussians, offset_px: Float[Tensor, "pixels chosen 2"]
) -> Float[Tensor, "pixels channels"]:
    """Front-to-back blending of Gaussians at offsets from their centres."""
    precision = torch.linalg.inv(chosen.covariance_px2)
    power = 0.5 * torch.einsum("pgi,gij,pgj->pg", offset_px, precision, offset_px)
    alpha = (chosen.opacity * torch.exp(-power)).clamp(max=MAX_ALPHA)
    alpha = torch.where(alpha >= ALPHA_CUT, alpha, torch.zeros_like(alpha))
    light_after = torch.cumprod(1.0 - alpha, dim=1)
    goes_on: Bool[Tensor, "pixels chosen"] = light_after.detach() >= MIN_TRANSMITTANCE
    alpha = alpha * goes_on
    light_after = torch.cumprod(1.0 - alpha, dim=1)
    ones = light_after.new_ones((len(light_after), 1))
    light_before = torch.cat([ones, light_after], dim=1)[:, :-1]
    blended = (alpha * light_before) @ chosen.values
    return torch.cat([1.0 - torch.cat([ones, light_after], dim=1)[:, -1:], blended], dim=1)


def harmonic_basis(
    direction: Float[Tensor, "directions 3"], coefficients: int
) -> Float[Tensor, "directions coefficients"]:
    """The first 1, 4, 9 or 16 real spherical harmonics at unit directions.

    Constants, order and signs are those of Kerbl et al. (2023).
    """
    x, y, z = direction.unbind(dim=1)
    basis = [torch.full_like(x, 0.28209479177387814)]
    if coefficients > 1:
        basis += [value * 0.4886025119029199 for value in (-y, z, -x)]
    if coefficients > 4:
        basis += [
            1.0925484305920792 * x * y,
            -1.0925484305920792 * y * z,
            0.31539156525252005 * (2 * z * z - x * x - y * y),
            -1.0925484305920792 * x * z,
            0.5462742152960396 * (x * x - y * y),
        ]
    if coefficients > 9:
        basis += [
            -0.5900435899266435 * y * (3 * x * x - y * y),
            2.890611442640554 * x * y * z,
            -0.4570457994644658 * y * (4 * z * z - x * x - y * y),
            0.3731763325901154 * z * (2 * z * z - 3 * x * x - 3 * y * y),
            -0.4570457994644658 * x * (4 * z * z - x * x - y * y),
            1.445305721320277 * z * (x * x - y * y),
            -0.5900435899266435 * x * (x * x - 3 * y * y),
        ]
    return torch.stack(basis, dim=1)
