"""Sky texture look-ups: a plain torch version, which is the law, and the choice of the fast one.

A texture covers a patch of the sphere of directions in equal steps of azimuth and elevation.
World frame: z up; azimuth is measured from x towards y, so columns run from left to right with
falling azimuth, rows from top to bottom with falling elevation. Angles are radians.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.kernels.sky_texture import cpu as sky_kernels


@dataclass(frozen=True, slots=True, kw_only=True)
class SkyLayout:
    """Which directions the texels of a sky texture stand for."""

    azimuth_left_rad: float
    elevation_top_rad: float
    texel_rad: float
    columns: int
    rows: int

    @property
    def wraps(self) -> bool:
        """Whether the texture runs all the way round, so that its sides meet."""
        return self.columns * self.texel_rad > 2 * math.pi - 0.5 * self.texel_rad


def locate(camera: Camera, layout: SkyLayout) -> Float[Tensor, "height width 2"]:
    """Continuous (column, row) of every pixel's ray; texel centres at +0.5."""
    directions = camera.pixel_directions().to(camera.world_from_camera.device)
    x, y, z = (directions @ camera.world_from_camera[:3, :3].float().T).unbind(-1)
    turn = layout.azimuth_left_rad - torch.atan2(y, x)
    margin = (2 * math.pi - layout.columns * layout.texel_rad) / 2
    turn = torch.remainder(turn + margin, 2 * math.pi) - margin
    drop = layout.elevation_top_rad - torch.atan2(z, torch.hypot(x, y))
    return torch.stack([turn, drop], dim=-1) / layout.texel_rad


def corners(
    places: Float[Tensor, "*pixels 2"], layout: SkyLayout
) -> tuple[Int[Tensor, "*pixels 4"], Float[Tensor, "*pixels 4"]]:
    """Flat indices of the four texels around each place, and their bilinear weights."""
    column, row = (places - 0.5).unbind(-1)
    row = row.clamp(0, layout.rows - 1)
    if not layout.wraps:
        column = column.clamp(0, layout.columns - 1)
    left, upper = column.floor(), row.floor()
    weight_right, weight_lower = column - left, row - upper
    c0, r0 = left.long(), upper.long()
    c1, r1 = c0 + 1, (r0 + 1).clamp(max=layout.rows - 1)
    if layout.wraps:
        c0, c1 = c0 % layout.columns, c1 % layout.columns
    else:
        c1 = c1.clamp(max=layout.columns - 1)
    indices = [r0 * layout.columns + c0, r0 * layout.columns + c1]
    indices += [r1 * layout.columns + c0, r1 * layout.columns + c1]
    weights = [(1 - weight_lower) * (1 - weight_right), (1 - weight_lower) * weight_right]
    weights += [weight_lower * (1 - weight_right), weight_lower * weight_right]
    return torch.stack(indices, dim=-1), torch.stack(weights, dim=-1)


def sample_reference(
    texture: Float[Tensor, "rows columns 3"], camera: Camera, layout: SkyLayout
) -> Float[Tensor, "height width 3"]:
    """Bilinear sky colour of every pixel; differentiable in the texture."""
    indices, weights = corners(locate(camera, layout).to(texture.device), layout)
    return (texture.flatten(0, 1)[indices] * weights[..., None]).sum(dim=-2)


@dataclass(frozen=True, kw_only=True, eq=False)
class SkyRays:
    """Where the rays of a camera meet a sky texture."""

    places: Float[Tensor, "height width 2"]
    """Continuous (column, row); of pixels that are not wanted, anything."""
    wanted: Bool[Tensor, "height width"]
    """Pixels whose sky colour matters."""


def sky_rays(
    camera: Camera, layout: SkyLayout, wanted: Bool[Tensor, "height width"] | None = None
) -> SkyRays:
    """The camera's rays in the texture; with `wanted`, only of these pixels."""
    if wanted is None:
        wanted = torch.ones(camera.height_px, camera.width_px, dtype=torch.bool)
    if wanted.device.type != "cpu":
        return SkyRays(places=locate(camera, layout).to(wanted.device), wanted=wanted)
    lens = torch.tensor([camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px]).float()
    extent = torch.tensor(
        [layout.azimuth_left_rad, layout.elevation_top_rad, layout.texel_rad, layout.columns]
    ).float()
    rotation = camera.world_from_camera[:3, :3].detach().float().contiguous()
    places = sky_kernels.locate(
        rotation.numpy(), lens.numpy(), extent.numpy(), wanted.contiguous().numpy()
    )
    return SkyRays(places=torch.from_numpy(places), wanted=wanted)


def sample_sky(
    texture: Float[Tensor, "rows columns 3"], rays: SkyRays, layout: SkyLayout
) -> Float[Tensor, "height width 3"]:
    """Bilinear sky colour of the wanted pixels, black elsewhere; without gradient."""
    if texture.device.type != "cpu":
        indices, weights = corners(rays.places, layout)
        rgb = (texture.detach().flatten(0, 1)[indices] * weights[..., None]).sum(dim=-2)
        return rgb * rays.wanted[..., None]
    rgb = sky_kernels.sample(
        texture.detach().numpy(),
        rays.places.numpy(),
        rays.wanted.contiguous().numpy(),
        layout.wraps,
    )
    return torch.from_numpy(rgb)


def scatter_gradient(
    gradient: Float[Tensor, "height width 3"],
    weight: Float[Tensor, "height width"],
    rays: SkyRays,
    layout: SkyLayout,
) -> tuple[Float[Tensor, "rows columns 3"], Float[Tensor, "rows columns"]]:
    """Carry pixel gradients to the texels.

    Only pixels of positive weight count; they must be among the wanted ones. Returns the texels'
    gradients and the weights summed on each of them.
    """
    if gradient.device.type == "cpu":
        texel_gradient, texel_weight = sky_kernels.scatter(
            (layout.rows, layout.columns),
            rays.places.numpy(),
            gradient.contiguous().numpy(),
            weight.contiguous().numpy(),
            layout.wraps,
        )
        return torch.from_numpy(texel_gradient), torch.from_numpy(texel_weight)
    return scatter_reference(gradient, weight, rays, layout)


def scatter_reference(
    gradient: Float[Tensor, "height width 3"],
    weight: Float[Tensor, "height width"],
    rays: SkyRays,
    layout: SkyLayout,
) -> tuple[Float[Tensor, "rows columns 3"], Float[Tensor, "rows columns"]]:
    """Plain torch twin of `scatter_gradient`."""
    indices, shares = corners(rays.places, layout)
    counts = weight > 0
    indices, shares = indices[counts].flatten(), shares[counts]
    texel_gradient = gradient.new_zeros(layout.rows * layout.columns, 3)
    texel_weight = gradient.new_zeros(layout.rows * layout.columns)
    parts = (shares[..., None] * gradient[counts][:, None]).flatten(0, 1)
    texel_gradient.index_add_(0, indices, parts)
    texel_weight.index_add_(0, indices, (shares * weight[counts][:, None]).flatten())
    size = (layout.rows, layout.columns)
    return texel_gradient.unflatten(0, size), texel_weight.unflatten(0, size)
