"""Damage painted onto a render while training: what a splat fit shows where it saw too little.

Speckle, patches that slid or dissolved, blur and needles, in random blobs. It stands beside the
damage of real fits, which the harvested pairs carry already, and keeps the painter from trusting
any render blindly. All functions draw from the generator they are given.
"""

import torch
import torch.nn.functional as F  # noqa: N812
from jaxtyping import Bool, Float
from torch import Generator, Tensor

from lidarpainter_models.painter.filters import blur

LARGEST_SLIDE_PX = 12
MOST_NEEDLES = 10


def damage_render(
    render: Float[Tensor, "3 height width"], generator: Generator
) -> Float[Tensor, "3 height width"]:
    """One or two kinds of damage, chosen at random."""
    kinds = (_speckle, _slide, _dissolve, _soften, _needles)
    for index in torch.randperm(len(kinds), generator=generator)[: 1 + _below(2, generator)]:
        render = kinds[int(index)](render, generator)
    return render


def _speckle(
    render: Float[Tensor, "3 height width"], generator: Generator
) -> Float[Tensor, "3 height width"]:
    """Rainbow noise, as in gaps seen only through what is left of the light."""
    blobs = _some_blobs(render, generator)
    noise = torch.rand(render.shape, generator=generator)
    strength = _between(0.3, 1.0, generator)
    spots = blobs & (torch.rand(blobs.shape, generator=generator) < _between(0.2, 1, generator))
    return torch.where(spots, render + strength * (noise - render), render)


def _slide(
    render: Float[Tensor, "3 height width"], generator: Generator
) -> Float[Tensor, "3 height width"]:
    """Blobs that show the image from a few pixels beside."""
    down, right = (_below(2 * LARGEST_SLIDE_PX + 1, generator) - LARGEST_SLIDE_PX for _ in "yx")
    moved = torch.roll(render, (down, right), dims=(1, 2))
    share = _between(0.4, 1.0, generator)
    return torch.where(_some_blobs(render, generator), render + share * (moved - render), render)


def _dissolve(
    render: Float[Tensor, "3 height width"], generator: Generator
) -> Float[Tensor, "3 height width"]:
    """Blobs through which one colour of the image shows, as sky does through holes."""
    row, column = _below(render.shape[1], generator), _below(render.shape[2], generator)
    colour = render[:, row, column, None, None]
    share = _between(0.4, 1.0, generator)
    return torch.where(_some_blobs(render, generator), render + share * (colour - render), render)


def _soften(
    render: Float[Tensor, "3 height width"], generator: Generator
) -> Float[Tensor, "3 height width"]:
    """Blobs out of focus."""
    soft = blur(render[None], sigma_px=_between(1.0, 3.5, generator))[0]
    return torch.where(_some_blobs(render, generator), soft, render)


def _needles(
    render: Float[Tensor, "3 height width"], generator: Generator
) -> Float[Tensor, "3 height width"]:
    """Thin streaks in colours of the image, most of them along one direction."""
    _, height_px, width_px = render.shape
    rows = torch.arange(height_px)[:, None].float()
    columns = torch.arange(width_px)[None].float()
    main_rad = _between(0, torch.pi, generator)
    for _ in range(2 + _below(MOST_NEEDLES - 1, generator)):
        angle = torch.tensor(main_rad + _between(-0.3, 0.3, generator))
        centre_row, centre_column = _below(height_px, generator), _below(width_px, generator)
        colour = render[:, _below(height_px, generator), _below(width_px, generator)]
        along = (columns - centre_column) * angle.cos() + (rows - centre_row) * angle.sin()
        beside = (rows - centre_row) * angle.cos() - (columns - centre_column) * angle.sin()
        length_px, width = _between(4, 40, generator), _between(0.5, 1.6, generator)
        shape = torch.exp(-0.5 * ((along / length_px) ** 2 + (beside / width) ** 2))
        opacity = _between(0.3, 1.0, generator) * shape
        render = render + opacity * (colour[:, None, None] - render)
    return render


def _some_blobs(
    render: Float[Tensor, "3 height width"], generator: Generator
) -> Bool[Tensor, "height width"]:
    """Smooth random blobs that cover a part of the image."""
    share = _between(0.03, 0.35, generator)
    _, height_px, width_px = render.shape
    rows, columns = max(height_px // 14, 2), max(width_px // 14, 2)
    coarse = torch.randn(1, 1, rows, columns, generator=generator)
    smooth = F.interpolate(coarse, size=(height_px, width_px), mode="bicubic")[0, 0]
    return smooth > smooth.flatten().quantile(1 - share)


def _between(low: float, high: float, generator: Generator) -> float:
    return low + (high - low) * float(torch.rand((), generator=generator))


def _below(limit: int, generator: Generator) -> int:
    return int(torch.randint(limit, (), generator=generator))
