"""Put Gaussians where the image is wrong, take them from where they do nothing.

Every Gaussian collects the absolute screen gradient of its centre (Ye et al. 2024, "AbsGS"), in
pixels of the full fit size. At intervals the faint ones and those that left their actor's box are
dropped, and the ones with the largest mean gradient are split in two along their longest axis. The
number never exceeds what is asked for.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from lidarpainter_models.gaussians.model.gaussian_set import GaussianSet, axes_at

BOX_MARGIN, BOX_MARGIN_M = 1.1, 0.1
"""An actor's Gaussian may lie this far out, in half sizes of its box, and this much further:
mirrors and antennas."""
MIN_OPACITY = 0.02
"""Fainter Gaussians are dropped."""


@dataclass(eq=False, kw_only=True)
class GradientTally:
    """Screen gradients collected since the last round."""

    total: Float[Tensor, " gaussians"]
    visits: Float[Tensor, " gaussians"]

    @classmethod
    def zeros(cls, count: int, device: torch.device | None = None) -> "GradientTally":
        """Nothing collected."""
        return cls(
            total=torch.zeros(count, device=device), visits=torch.zeros(count, device=device)
        )

    def add(
        self,
        rows: Int[Tensor, " seen"],
        gradient: Float[Tensor, " seen"],
        visible: Bool[Tensor, " seen"],
    ) -> None:
        """Collect one view's gradients of some rows, in place."""
        self.total.index_add_(0, rows, torch.where(visible, gradient, 0.0))
        self.visits.index_add_(0, rows, visible.float())

    @property
    def mean(self) -> Float[Tensor, " gaussians"]:
        """Mean over the looks that took each in (`occlusion_culling`) where it was in the image."""
        return self.total / self.visits.clamp(min=1)


@dataclass(frozen=True, kw_only=True, eq=False)
class SetChange:
    """A changed set: rows of the old one that stay, in order, then fresh rows."""

    gaussians: GaussianSet
    kept: Int[Tensor, " kept"]
    num_added: int


def densify(
    gaussians: GaussianSet,
    tally: GradientTally,
    box_sizes_m: Sequence[Float[Tensor, "3"]],
    *,
    target: int,
) -> SetChange:
    """Drop the useless, then split those with the largest gradients until there are `target`."""
    stays = keeps_its_place(gaussians, box_sizes_m)
    room = target - int(stays.sum())
    score = torch.where(stays & (tally.visits > 0), tally.mean, torch.zeros_like(tally.mean))
    num_split = max(min(room, int((score > 0).sum())), 0)
    # a stable sort, so that equal scores never depend on the machine
    chosen = torch.argsort(score, descending=True, stable=True)[:num_split]
    is_split = torch.zeros_like(stays)
    is_split[chosen] = True
    kept = (stays & ~is_split).nonzero()[:, 0]
    children = split_along_longest_axis(gaussians.select(is_split.nonzero()[:, 0]))
    return SetChange(
        gaussians=gaussians.select(kept).append(children), kept=kept, num_added=len(children)
    )


def prune(gaussians: GaussianSet, box_sizes_m: Sequence[Float[Tensor, "3"]]) -> SetChange:
    """Drop the useless and nothing else."""
    kept = keeps_its_place(gaussians, box_sizes_m).nonzero()[:, 0]
    return SetChange(gaussians=gaussians.select(kept), kept=kept, num_added=0)


def keeps_its_place(
    gaussians: GaussianSet, box_sizes_m: Sequence[Float[Tensor, "3"]]
) -> Bool[Tensor, " gaussians"]:
    """Which Gaussians are finite, not faint and, on an actor, still in its box."""
    columns = gaussians.columns()
    stays = columns["opacity_logit"].sigmoid() >= MIN_OPACITY
    for name in ("means", "log_scale"):
        stays &= columns[name].isfinite().all(dim=1)
    if box_sizes_m:
        half_m = torch.stack([size.float() for size in box_sizes_m]) / 2
        half_m = half_m * BOX_MARGIN + BOX_MARGIN_M
        half_m = torch.cat([torch.full((1, 3), torch.inf), half_m]).to(stays.device)
        stays &= (columns["means"].abs() <= half_m[columns["body_index"].long()]).all(dim=1)
    return stays


def split_along_longest_axis(parents: GaussianSet) -> GaussianSet:
    """Two halves for each Gaussian, side by side along its longest axis.

    With centres at +-0.75 sigma and 0.66 sigma wide the pair has the parent's spread.
    """
    columns = parents.columns()
    longest = columns["log_scale"].argmax(dim=1)
    rows = torch.arange(len(parents), device=longest.device)
    direction = axes_at(columns["rotation_wxyz"], longest)
    offset_m = 0.75 * columns["log_scale"][rows, longest].exp()[:, None] * direction
    log_scale = columns["log_scale"].clone()
    log_scale[rows, longest] += torch.log(torch.tensor(0.66))
    first, second = (
        GaussianSet(**columns | {"means": columns["means"] + way_m, "log_scale": log_scale})
        for way_m in (offset_m, -offset_m)
    )
    return first.append(second)
