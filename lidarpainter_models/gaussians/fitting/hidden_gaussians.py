"""Gaussians that a view's frustum holds and its image does not show, left out of its next steps.

Of what lies before a camera in a street much is behind something else, the more the longer the
street. It has no gradient, but would be brought up to date, projected, sorted and stepped all the
same. So a view takes all that its frustum holds at its first look and again every few looks, and
learns by the way how many pixels each Gaussian fills there: the sum of the weights with which it is
blended. What fills next to none is left out until then, by its number, which a Gaussian keeps for
as long as it lives; new ones are never left out unseen.
"""

from dataclasses import dataclass, field

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from lidarpainter_models.kernels.gaussian_raster import SplatImage

LOOKS = 16
"""Looks from one at everything to the next."""
LEAST_PX = 0.02
"""A Gaussian that fills less is left out: together they make some thousandths of an image."""
PROBE = 1e-12
"""Weight of the channel that measures, in the loss: its gradient is read, and moves nothing by more
than a rounding."""


@dataclass(eq=False, kw_only=True)
class HiddenGaussians:
    """What each view leaves out. Views are numbered: n-th recorded one n, n-th painted one ~n."""

    number: Int[Tensor, " gaussians"]
    """Of each Gaussian, int32; never given again."""
    row: Int[Tensor, " numbers"]
    """Where each number stands in the set; one past its end where the Gaussian is gone."""
    hidden: dict[int, Int[Tensor, " hidden"]] = field(default_factory=dict)
    """By view the numbers of those left out."""
    looks: dict[int, int] = field(default_factory=dict)
    """By view the looks since the last one at everything."""

    @classmethod
    def none_yet(cls, count: int, device: torch.device) -> "HiddenGaussians":
        """Of so many Gaussians, which no view has looked at."""
        number = torch.arange(count, dtype=torch.int32, device=device)
        return cls(number=number, row=number.long())

    def is_due(self, view: int) -> bool:
        """Whether a view is to look at everything this time."""
        return self.looks.get(view, LOOKS) >= LOOKS

    def without(self, is_seen: Bool[Tensor, " gaussians"], view: int) -> Bool[Tensor, " gaussians"]:
        """Of what a view's frustum holds, what it looks at this time."""
        if self.is_due(view):
            return is_seen
        flags = torch.cat([is_seen, is_seen.new_zeros(1)])  # the last for those that are gone
        return flags.index_fill_(0, self.row[self.hidden[view].long()], False)[:-1]

    def probe(self, view: int, count: int) -> Float[Tensor, "gaussians 1"] | None:
        """Ones to blend along where a view looks at everything; collects what each fills."""
        if not self.is_due(view):
            return None
        return torch.ones(count, 1, device=self.row.device, requires_grad=True)

    def learn(
        self, view: int, rows: Int[Tensor, " seen"], probe: Float[Tensor, "seen 1"] | None
    ) -> None:
        """Take up what the probe of a look at these rows collected; None was another look."""
        if probe is None:
            self.looks[view] += 1
            return
        if probe.grad is None:
            raise AssertionError("the probe took no part in the loss")
        self.hidden[view] = self.number[rows[probe.grad[:, 0] < PROBE * LEAST_PX]]
        self.looks[view] = 1

    def follow(self, kept: Int[Tensor, " kept"], num_added: int) -> None:
        """Take up a change of the set: rows kept, in order, then fresh ones."""
        device, given = self.row.device, len(self.row)
        fresh = torch.arange(given, given + num_added, dtype=torch.int32, device=device)
        self.number = torch.cat([self.number[kept], fresh])
        count = len(self.number)
        self.row = torch.full((given + num_added,), count, device=device)
        self.row.scatter_(0, self.number.long(), torch.arange(count, device=device))

    def tensors(self) -> dict[str, Tensor]:
        """State to be kept in a checkpoint."""
        views = list(self.hidden)
        lists = [self.hidden[view] for view in views]
        return {
            "number": self.number,
            "row": self.row,
            "views": torch.tensor(views, dtype=torch.int64),
            "looks": torch.tensor([self.looks[view] for view in views], dtype=torch.int64),
            "sizes": torch.tensor([len(listed) for listed in lists], dtype=torch.int64),
            "listed": torch.cat([self.number[:0], *lists]),
        }

    @classmethod
    def from_tensors(cls, tensors: dict[str, Tensor], device: torch.device) -> "HiddenGaussians":
        """The state that `tensors` described."""
        views, looks = tensors["views"].tolist(), tensors["looks"].tolist()
        lists = tensors["listed"].to(device).split(tensors["sizes"].tolist())
        return cls(
            number=tensors["number"].to(device),
            row=tensors["row"].to(device),
            hidden=dict(zip(views, lists, strict=True)),
            looks=dict(zip(views, looks, strict=True)),
        )


def probed(splat: SplatImage, probe: Float[Tensor, "gaussians 1"] | None) -> Float[Tensor, ""]:
    """The term of the loss from which a probe, the last channel blended, collects."""
    return splat.alpha.new_zeros(()) if probe is None else PROBE * splat.features[..., -1].sum()
