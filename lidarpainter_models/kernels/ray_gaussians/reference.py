"""What rays meet of Gaussians in plain torch: every ray against every Gaussian; the law."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from lidarpainter_models.kernels import ray_gaussians as rules
from lidarpainter_models.kernels.ray_gaussians import Ellipsoids, RayHits, RayReturns, Rays

MOST_PAIRS = 2**22
"""Rays times Gaussians looked at in one go: a few hundred megabytes."""


def trace_rays(rays: Rays, gaussians: Ellipsoids, most_hits: int) -> RayReturns:
    """See `ray_gaussians.trace_rays`."""
    count = max(1, MOST_PAIRS // max(len(gaussians.means), 1))
    parts = [
        _traced(Rays(*columns), gaussians, most_hits)
        for columns in zip(*(column.split(count) for column in rays), strict=True)
    ]
    hits = [part.hits for part in parts]
    rest = {name: torch.cat([getattr(part, name) for part in parts]) for name in rules.BLENDED}
    return RayReturns(
        **rest, hits=RayHits(*(torch.cat(column) for column in zip(*hits, strict=True)))
    )


def _traced(rays: Rays, gaussians: Ellipsoids, most_hits: int) -> RayReturns:
    everything = _answers(rays, gaussians)
    order = everything.range_m.argsort(dim=1, stable=True)
    sorted_hits = RayHits(*(column.gather(1, order) for column in everything))
    weight = rules.blended_hits(sorted_hits, gaussians.opacity)
    through = 1 - weight.cumsum(dim=1)
    weight = weight * (through + weight >= rules.LEFT_OVER)
    alpha = weight.sum(dim=1)
    index = sorted_hits.row.clamp(min=0)
    range_m = torch.where(weight > 0, sorted_hits.range_m, 0.0)
    half, place = _first(through < 0.5)
    kept = [column[:, :most_hits] for column in sorted_hits]
    padding = (0, max(most_hits - sorted_hits.row.shape[1], 0))
    fill = (-1, 0, 0, 0, 0)
    padded = (torch.nn.functional.pad(*pair) for pair in zip(kept, [padding] * 5, strict=True))
    is_listed = torch.nn.functional.pad(weight[:, :most_hits] > 0, padding)
    return RayReturns(
        range_m=(weight * range_m).sum(dim=1) / alpha.clamp(min=1e-9),
        median_m=torch.where(half, _at(sorted_hits.range_m, place), torch.inf),
        alpha=alpha,
        cosine=(weight * sorted_hits.cosine).sum(dim=1),
        channels=torch.einsum("rh,rhc->rc", weight, gaussians.channels[index]),
        nearest=torch.where(half, _at(sorted_hits.row, place), rules.NOTHING),
        hits=RayHits(
            *(torch.where(is_listed, *pair) for pair in zip(padded, map(_like, fill), strict=True))
        ),
    )


def _like(value: int) -> Tensor:
    return torch.tensor(value)


def _at(values: Tensor, place: Tensor) -> Tensor:
    """The value of each row at a place; of rows without any, nothing that is used."""
    if values.shape[1] == 0:
        return values.new_zeros(len(values))
    return values.gather(1, place[:, None])[:, 0]


def _first(is_so: Bool[Tensor, "rays hits"]) -> tuple[Tensor, Tensor]:
    """Whether anything is so in each row, and the first place where it is."""
    if is_so.shape[1] == 0:
        nowhere = torch.zeros(len(is_so), dtype=torch.int64, device=is_so.device)
        return nowhere.bool(), nowhere
    return is_so.any(dim=1), is_so.int().argmax(dim=1)


def _answers(rays: Rays, gaussians: Ellipsoids) -> RayHits:
    """The answer of every Gaussian to every ray; index -1 and range inf where there is none."""
    direction, whitening = rays.direction, gaussians.axes / gaussians.scale_m[..., None]
    moved = rays.after_s[:, None, None] * gaussians.velocity_mps
    to_mean = gaussians.means + moved - rays.origin_m[:, None]
    along_m = torch.einsum("rgi,ri->rg", to_mean, direction)
    nearest = along_m[..., None] * direction[:, None] - to_mean
    start = torch.einsum("gij,rgj->rgi", whitening, nearest)
    way = torch.einsum("gij,rj->rgi", whitening, direction)
    way_squared = way.square().sum(dim=-1).clamp(min=1e-30)
    on_m = -(start * way).sum(dim=-1) / way_squared
    apart = (start + on_m[..., None] * way).square().sum(dim=-1)
    response, range_m = torch.exp(-0.5 * apart), along_m + on_m
    is_met = (gaussians.opacity * response >= rules.FAINTEST) & (range_m > rules.NEAREST_M)
    thin = gaussians.scale_m.argmin(dim=1, keepdim=True)
    normal = gaussians.axes.gather(1, thin[..., None].expand(-1, 1, 3))[:, 0]
    along_thin = way.gather(2, thin.expand(len(direction), -1, 1))[..., 0]
    slope = along_thin / gaussians.scale_m.gather(1, thin)[:, 0] / way_squared
    rows = torch.arange(len(gaussians.means), device=direction.device).expand_as(response)
    cosine: Float[Tensor, "rays gaussians"] = (direction @ normal.T).abs()
    return RayHits(
        row=torch.where(is_met, rows, -1),
        response=torch.where(is_met, response, 0.0),
        range_m=torch.where(is_met, range_m, torch.inf),
        slope=torch.where(is_met, slope, 0.0),
        cosine=torch.where(is_met, cosine, 0.0),
    )
