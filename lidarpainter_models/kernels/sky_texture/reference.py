"""Sky texture look-ups in plain torch: the law for the fast version, on any device."""

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import grid_sample

from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.kernels.sky_texture import SkyLayout, SkyRays, TexelMoments


def locate(
    camera: Camera, layout: SkyLayout, wanted: Bool[Tensor, "height width"]
) -> Float[Tensor, "height width 2"]:
    """Continuous (column, row) of every pixel's ray."""
    directions = camera.pixel_directions(wanted.device)
    rotation = camera.world_from_camera[:3, :3].detach().float()
    x, y, z = (directions @ rotation.T.to(wanted.device, non_blocking=True)).unbind(-1)
    turn = layout.azimuth_left_rad - torch.atan2(y, x)
    margin = (2 * math.pi - layout.columns * layout.texel_rad) / 2
    turn = torch.where(turn < -margin, turn + 2 * math.pi, turn)
    turn = torch.where(turn >= 2 * math.pi - margin, turn - 2 * math.pi, turn)
    drop = layout.elevation_top_rad - torch.atan2(z, (x * x + y * y).sqrt())
    return torch.stack([turn, drop], dim=-1) / layout.texel_rad


def sample(
    texture: Float[Tensor, "rows columns 3"], rays: SkyRays, layout: SkyLayout
) -> Float[Tensor, "height width 3"]:
    """Bilinear colour of the wanted pixels, black elsewhere; differentiable in the texture."""
    image = _ringed(texture, layout).permute(2, 0, 1)[None]
    grid = _grid(rays, layout, texture.dtype)
    rgb = grid_sample(image, grid, padding_mode="border", align_corners=False)
    return torch.where(rays.wanted[..., None], rgb[0].permute(1, 2, 0), 0.0)


def scatter(
    gradient: Float[Tensor, "height width 3"],
    weight: Float[Tensor, "height width"],
    rays: SkyRays,
    layout: SkyLayout,
) -> tuple[Float[Tensor, "rows columns 3"], Float[Tensor, "rows columns"]]:
    """Transpose of `sample` on pixels of positive weight: texel gradients and summed weights."""
    values = torch.cat([gradient.permute(2, 0, 1), weight[None]])
    values = torch.where(weight > 0, values, 0.0)[None]
    ring = 1 if layout.wraps else 0
    image = values.new_zeros(1, 4, layout.rows, layout.columns + 2 * ring)
    bilinear, border = 0, 1  # as torch numbers modes of interpolation and padding
    found, _ = torch.ops.aten.grid_sampler_2d_backward(
        values, image, _grid(rays, layout, values.dtype), bilinear, border, False, [True, False]
    )
    texels = found[0, :, :, ring : ring + layout.columns]
    if ring:  # what fell on the other side's column
        texels[..., -1] += found[0, :, :, 0]
        texels[..., 0] += found[0, :, :, -1]
    return texels[:3].permute(1, 2, 0).contiguous(), texels[3].contiguous()


def adam(
    texture: Float[Tensor, "rows columns 3"],
    moments: TexelMoments,
    gradient: Float[Tensor, "rows columns 3"],
    weight: Float[Tensor, "rows columns"],
    learning_rate: float,
) -> None:
    """One Adam step on every texel of positive weight, in place; the others stay as they are."""
    touched = weight > 0
    moments.visits.add_(touched)
    # of each number, for what is spread over three colours within an operation is slow on a CPU
    count = moments.visits.clamp(1, 1000).to(texture.dtype)
    bias_1, bias_2 = (
        -torch.expm1(count * math.log(beta))[..., None].expand_as(texture).contiguous()
        for beta in (0.9, 0.99)
    )
    touched = touched[..., None].expand_as(texture).contiguous()
    share = touched.to(texture.dtype)
    moments.first.lerp_(gradient, 0.1 * share)
    moments.second.lerp_(gradient.square(), 0.01 * share)
    spread = moments.second.div(bias_2).sqrt_().add_(1e-12)
    stepped = texture - moments.first.div(bias_1).div_(spread).mul_(learning_rate)
    texture.copy_(torch.where(touched, stepped.clamp_(0, 1), texture))


def _ringed(
    texture: Float[Tensor, "rows columns channels"], layout: SkyLayout
) -> Float[Tensor, "rows ringed channels"]:
    """The texture; one that runs all the way round with a column of the other side at each end."""
    return torch.cat([texture[:, -1:], texture, texture[:, :1]], dim=1) if layout.wraps else texture


def _grid(
    rays: SkyRays, layout: SkyLayout, dtype: torch.dtype
) -> Float[Tensor, "1 height width 2"]:
    """Places as `grid_sample` wants them: from -1 to 1 over the ringed texture."""
    ring = 1 if layout.wraps else 0
    column, row = rays.places.to(dtype).unbind(-1)
    column = (column + ring) * (2 / (layout.columns + 2 * ring))
    return torch.stack([column, row * (2 / layout.rows)], dim=-1)[None] - 1
