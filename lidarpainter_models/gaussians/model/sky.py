"""The sky: a texture of colours by direction, behind everything else.

What LiDAR never reaches is taken to be infinitely far. A texel learns only from pixels that the
Gaussians leave clear (transmittance above a gate): seen through a wire or the rim of a tree, it
would grow as bright as these are dark, and from another lane shine beside them. Texels that no
image shows are filled in from their neighbours by push and pull (Gortler et al., 1996).
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from lidarpainter_models.devices import on_device
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.kernels.sky_texture import (
    SkyLayout,
    SkyRays,
    TexelMoments,
    sample_sky,
    scatter_gradient,
    sky_rays,
    step_texels,
)

_FULL_TURN_FROM_RAD = math.radians(270)
LOWEST_RAD = math.radians(-8)
"""Elevation of the lowest row; below it, the lowest row's colour goes on."""
MARGIN_RAD = math.radians(6)
"""Room left and right of the training views before the edge colour goes on."""
LEARNING_RATE, FINAL_LEARNING_RATE = 0.01, 0.001
"""First and last Adam step, in colour units."""
MAX_TEXELS = 2_000_000
"""The texture is coarsened to stay below this (a full turn of sharp cameras is 8 million)."""
MIN_TRANSMITTANCE = 0.9
"""A texel learns only through pixels clearer than this."""


class _Part(NamedTuple):
    """Some columns of a texture, as a texture of their own."""

    first: int
    layout: SkyLayout
    rays: SkyRays


@dataclass(frozen=True, eq=False, kw_only=True)
class SkyTexture:
    """Colours by world direction; a fit changes its tensors in place."""

    layout: SkyLayout
    rgb: Float[Tensor, "rows columns 3"]
    weight: Float[Tensor, "rows columns"]
    """How much clear image each texel has seen; 0 where the colour is a guess."""
    moments: TexelMoments
    """Moments of the optimiser: a fit that goes on from this sky needs them."""

    @classmethod
    def constant(cls, layout: SkyLayout, rgb: Float[Tensor, "3"]) -> "SkyTexture":
        """One colour everywhere, nothing seen yet."""
        size = (layout.rows, layout.columns)
        return cls(
            layout=layout,
            rgb=rgb.float().expand(*size, 3).clone(),
            weight=torch.zeros(size, device=rgb.device),
            moments=TexelMoments(
                first=torch.zeros(*size, 3, device=rgb.device),
                second=torch.zeros(*size, 3, device=rgb.device),
                visits=torch.zeros(size, dtype=torch.int32, device=rgb.device),
            ),
        )

    def to(self, device: torch.device) -> "SkyTexture":
        """The same sky on another device."""
        return replace(on_device(self, device), moments=on_device(self.moments, device))

    def rays(self, camera: Camera, wanted: Bool[Tensor, "height width"] | None = None) -> SkyRays:
        """Where the camera's rays (of the wanted pixels) meet the texture."""
        if wanted is None:
            size = (camera.height_px, camera.width_px)
            wanted = torch.ones(size, dtype=torch.bool, device=self.rgb.device)
        return sky_rays(camera, self.layout, wanted)

    def sample(self, rays: SkyRays) -> Float[Tensor, "height width 3"]:
        """Colour along the rays, without gradient."""
        return sample_sky(self.rgb, rays, self.layout)

    def observe(
        self,
        gradient: Float[Tensor, "height width 3"],
        clear: Float[Tensor, "height width"],
        rays: SkyRays,
        learning_rate: float,
    ) -> None:
        """One optimiser step on the texels seen through pixels of positive `clear`, in place."""
        part = self._met(rays, clear > 0)
        first, last = part.first, part.first + part.layout.columns
        texel_gradient, texel_weight = scatter_gradient(gradient, clear, part.rays, part.layout)
        self.weight[:, first:last] += texel_weight
        moments = TexelMoments(
            first=self.moments.first[:, first:last],
            second=self.moments.second[:, first:last],
            visits=self.moments.visits[:, first:last],
        )
        step_texels(self.rgb[:, first:last], moments, texel_gradient, texel_weight, learning_rate)

    def _met(self, rays: SkyRays, learns: Bool[Tensor, "height width"]) -> _Part:
        """The columns that rays meet, on a CPU: a camera sees a part, and to clear all takes time.

        All of them on a GPU, which would have to be waited for, and where rays meet the seam.
        """
        everything = _Part(0, self.layout, rays)
        if rays.places.device.type != "cpu" or not bool(learns.any()):
            return everything
        columns = rays.places[..., 0][learns] - 0.5  # between the centres of two texels each
        first, last = int(columns.min().floor()), int(columns.max().floor()) + 2
        if self.layout.wraps and (first < 0 or last > self.layout.columns):
            return everything
        first, last = max(first, 0), min(last, self.layout.columns)
        layout = replace(
            self.layout,
            azimuth_left_rad=self.layout.azimuth_left_rad - first * self.layout.texel_rad,
            columns=last - first,
        )
        places = rays.places - torch.tensor([float(first), 0.0])
        return _Part(first, layout, replace(rays, places=places))

    def filled(self) -> "SkyTexture":
        """The same sky with every unseen texel filled in from seen ones."""
        known = self.weight.clamp(max=1.0)
        return replace(self, rgb=push_pull(self.rgb, known, wraps=self.layout.wraps))


def sky_layout(cameras: Sequence[Camera]) -> SkyLayout:
    """The patch of sky that the cameras can see, or all of it where they look all round."""
    azimuth, elevation = _border_directions(cameras)
    middle = torch.atan2(azimuth.sin().mean(), azimuth.cos().mean())
    offset = torch.remainder(azimuth - middle + math.pi, 2 * math.pi) - math.pi
    left, right = float(offset.max()) + MARGIN_RAD, float(-offset.min()) + MARGIN_RAD
    top = min(float(elevation.max()) + MARGIN_RAD, math.pi / 2)
    top = max(top, LOWEST_RAD + 0.1)
    texel = 1.0 / max(camera.fx_px for camera in cameras)  # finer could not be seen
    is_full = left + right > _FULL_TURN_FROM_RAD
    width = 2 * math.pi if is_full else left + right
    texel *= max(1.0, math.sqrt(width * (top - LOWEST_RAD) / texel**2 / MAX_TEXELS))
    columns = max(math.ceil(width / texel), 2)
    if is_full:
        texel = 2 * math.pi / columns
    return SkyLayout(
        azimuth_left_rad=math.pi if is_full else float(middle) + left,
        elevation_top_rad=top,
        texel_rad=texel,
        columns=columns,
        rows=max(math.ceil((top - LOWEST_RAD) / texel), 2),
    )


def sky_from_images(
    layout: SkyLayout,
    cameras: Sequence[Camera],
    images: Iterable[Float[Tensor, "height width 3"]],
    masks: Sequence[Bool[Tensor, "height width"]],
) -> SkyTexture:
    """The mean colour of the images' sky pixels by direction, filled in where there is none."""
    total = torch.zeros(layout.rows, layout.columns, 3)
    weight = torch.zeros(layout.rows, layout.columns)
    for camera, image, mask in zip(cameras, images, masks, strict=True):
        part, part_weight = scatter_gradient(
            image, mask.float(), sky_rays(camera, layout, mask), layout
        )
        total += part
        weight += part_weight
    if not bool((weight > 0).any()):
        return SkyTexture.constant(layout, torch.full((3,), 0.7))
    mean = total / weight.clamp(min=1e-6)[..., None]
    sky = SkyTexture.constant(layout, torch.zeros(3))
    return replace(sky, rgb=push_pull(mean, weight.clamp(max=1.0), wraps=layout.wraps))


def seen_as_sky(
    layout: SkyLayout,
    cameras: Sequence[Camera],
    masks: Sequence[Bool[Tensor, "height width"]],
    asked: Sequence[Bool[Tensor, "height width"]],
) -> list[Bool[Tensor, "height width"]]:
    """Each camera's pixels, of those asked for, whose direction lies in any camera's mask."""
    weight = torch.zeros(layout.rows, layout.columns)
    for camera, mask in zip(cameras, masks, strict=True):
        nothing = torch.zeros(*mask.shape, 3)
        rays = sky_rays(camera, layout, mask)
        weight += scatter_gradient(nothing, mask.float(), rays, layout)[1]
    seen = (weight > 0).float()[..., None].expand(-1, -1, 3).contiguous()
    return [
        sample_sky(seen, sky_rays(camera, layout, wanted), layout)[..., 0] > 0.5
        for camera, wanted in zip(cameras, asked, strict=True)
    ]


def push_pull(
    rgb: Float[Tensor, "rows columns 3"],
    known: Float[Tensor, "rows columns"],
    *,
    wraps: bool = False,
) -> Float[Tensor, "rows columns 3"]:
    """Keep known texels (1), replace unknown ones (0) by a smooth continuation of the known."""
    rows, columns = known.shape
    if rows <= 1 and columns <= 1:
        return rgb
    colour = (rgb * known[..., None]).permute(2, 0, 1)[None]
    mode = "circular" if wraps else "replicate"
    pad_columns = columns % 2
    colour = torch.nn.functional.pad(colour, (0, pad_columns, 0, 0), mode=mode)
    weight = torch.nn.functional.pad(known[None, None], (0, pad_columns, 0, 0), mode=mode)
    colour = torch.nn.functional.pad(colour, (0, 0, 0, rows % 2), mode="replicate")
    weight = torch.nn.functional.pad(weight, (0, 0, 0, rows % 2), mode="replicate")
    coarse = torch.nn.functional.avg_pool2d(colour, 2)
    coarse_weight = torch.nn.functional.avg_pool2d(weight, 2)
    coarse_rgb = (coarse / coarse_weight.clamp(min=1e-8))[0].permute(1, 2, 0)
    coarse_known = (coarse_weight[0, 0] * 4).clamp(max=1.0)
    below = push_pull(coarse_rgb, coarse_known, wraps=wraps).permute(2, 0, 1)[None]
    guess = torch.nn.functional.interpolate(
        below, size=colour.shape[-2:], mode="bilinear", align_corners=False
    )[0, :, :rows, :columns].permute(1, 2, 0)
    return known[..., None] * rgb + (1 - known[..., None]) * guess


def _border_directions(
    cameras: Sequence[Camera],
) -> tuple[Float[Tensor, " rays"], Float[Tensor, " rays"]]:
    """Azimuth and elevation of a sparse grid of rays of every camera, border included."""
    found = []
    for camera in cameras:
        u = torch.linspace(0, camera.width_px, 9, dtype=torch.float64)
        v = torch.linspace(0, camera.height_px, 9, dtype=torch.float64)
        x = ((u - camera.cx_px) / camera.fx_px)[None, :].expand(9, 9)
        y = ((v - camera.cy_px) / camera.fy_px)[:, None].expand(9, 9)
        rays = torch.stack([x, y, torch.ones_like(x)], dim=-1).flatten(0, 1)
        found.append(rays @ camera.world_from_camera[:3, :3].double().T)
    x, y, z = torch.cat(found).unbind(-1)
    return torch.atan2(y, x), torch.atan2(z, torch.hypot(x, y))
