"""Sky texture look-ups in plain torch: the law for the fast version, on any device."""

import math

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.kernels.sky_texture.layout import SkyLayout, SkyRays, TexelMoments


def locate(
    camera: Camera, layout: SkyLayout, wanted: Bool[Tensor, "height width"]
) -> Float[Tensor, "height width 2"]:
    """Continuous (column, row) of every pixel's ray."""
    directions = camera.pixel_directions().to(camera.world_from_camera.device)
    x, y, z = (directions @ camera.world_from_camera[:3, :3].float().T).unbind(-1)
    turn = layout.azimuth_left_rad - torch.atan2(y, x)
    margin = (2 * math.pi - layout.columns * layout.texel_rad) / 2
    turn = torch.remainder(turn + margin, 2 * math.pi) - margin
    drop = layout.elevation_top_rad - torch.atan2(z, torch.hypot(x, y))
    return (torch.stack([turn, drop], dim=-1) / layout.texel_rad).to(wanted.device)


def sample(
    texture: Float[Tensor, "rows columns 3"], rays: SkyRays, layout: SkyLayout
) -> Float[Tensor, "height width 3"]:
    """Bilinear colour of the wanted pixels, black elsewhere; differentiable in the texture."""
    indices, weights = _corners(rays.places, layout)
    rgb = (texture.flatten(0, 1)[indices] * weights[..., None]).sum(dim=-2)
    return rgb * rays.wanted[..., None]


def scatter(
    gradient: Float[Tensor, "height width 3"],
    weight: Float[Tensor, "height width"],
    rays: SkyRays,
    layout: SkyLayout,
) -> tuple[Float[Tensor, "rows columns 3"], Float[Tensor, "rows columns"]]:
    """Transpose of `sample` on pixels of positive weight: texel gradients and summed weights."""
    indices, shares = _corners(rays.places, layout)
    counts = weight > 0
    indices, shares = indices[counts].flatten(), shares[counts].to(gradient.dtype)
    texel_gradient = gradient.new_zeros(layout.rows * layout.columns, 3)
    texel_weight = gradient.new_zeros(layout.rows * layout.columns)
    parts = (shares[..., None] * gradient[counts][:, None]).flatten(0, 1)
    texel_gradient.index_add_(0, indices, parts)
    texel_weight.index_add_(0, indices, (shares * weight[counts][:, None]).flatten())
    size = (layout.rows, layout.columns)
    return texel_gradient.unflatten(0, size), texel_weight.unflatten(0, size)


def adam(
    texture: Float[Tensor, "rows columns 3"],
    moments: TexelMoments,
    gradient: Float[Tensor, "rows columns 3"],
    weight: Float[Tensor, "rows columns"],
    learning_rate: float,
) -> None:
    """One Adam step on every texel of positive weight, in place."""
    touched = weight > 0
    moments.visits[touched] += 1
    count = moments.visits[touched].clamp(max=1000).to(texture.dtype)[:, None]
    g = gradient[touched]
    moments.first[touched] = 0.9 * moments.first[touched] + 0.1 * g
    moments.second[touched] = 0.99 * moments.second[touched] + 0.01 * g * g
    mean = moments.first[touched] / (1 - 0.9**count)
    spread = (moments.second[touched] / (1 - 0.99**count)).sqrt() + 1e-12
    texture[touched] = (texture[touched] - learning_rate * mean / spread).clamp(0, 1)


def _corners(
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
