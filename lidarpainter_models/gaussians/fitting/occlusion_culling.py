"""Gaussians that a view's frustum holds and its image does not show, left out of its next steps.

Of what lies before a camera in a street much is behind something else, the more the longer the
street. It has no gradient, but would be brought up to date, projected, sorted and stepped all the
same. So a view looks at all that its frustum holds at first and now and then again, and learns by
the way how many pixels each Gaussian fills there: the sum of the weights with which it is blended.
What fills next to none is left out until then, by its number, which a Gaussian keeps for as long as
it lives; new ones are never left out unseen.
"""

from dataclasses import dataclass, field

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from lidarpainter_models.kernels.gaussian_raster import SplatImage

FIRST_LOOKS = (0, 4, 12)
"""Looks of a view, counted from 0, at everything while the scene still changes fast."""
LOOKS_BETWEEN = 16
"""Looks from one at everything to the next, later on."""
LEAST_PX = 0.02
"""A Gaussian that fills less is left out: together they make some thousandths of an image."""
PROBE = 1e-24
"""Weight in the loss of the channel that measures. Adam makes whole steps of the smallest gradient
that stands alone, so this one lies far below the least that it tells from none."""


@dataclass(eq=False, kw_only=True)
class HiddenGaussians:
    """What each view leaves out. The n-th recorded view is called n, the n-th painted one ~n."""

    number: Int[Tensor, " gaussians"]
    """Number of each Gaussian, int32; no number is given twice."""
    row_of_number: Int[Tensor, " numbers"]
    """Row at which each number stands in the set; one past its end where the Gaussian is gone."""
    left_out: dict[int, Int[Tensor, " hidden"]] = field(default_factory=dict)
    """Numbers of the Gaussians that each view leaves out."""
    looks: dict[int, int] = field(default_factory=dict)
    """Looks of each view so far."""
    _in_view: dict[int, Bool[Tensor, " gaussians"]] = field(default_factory=dict, repr=False)
    """What the frustum holds of each view that looks at everything in this step."""

    @classmethod
    def none_yet(cls, num_gaussians: int, device: torch.device) -> "HiddenGaussians":
        """Return the start: so many Gaussians, which no view has looked at."""
        number = torch.arange(num_gaussians, dtype=torch.int32, device=device)
        return cls(number=number, row_of_number=number.long())

    def is_due(self, view: int) -> bool:
        """Whether a view is to look at everything this time."""
        looks = self.looks.get(view, 0)
        return looks in FIRST_LOOKS or looks % LOOKS_BETWEEN == FIRST_LOOKS[-1]

    def without(self, in_view: Bool[Tensor, " gaussians"], view: int) -> Bool[Tensor, " gaussians"]:
        """Return which Gaussians a view looks at this time, of those that its frustum holds."""
        if self.is_due(view):
            self._in_view[view] = in_view
            return in_view
        flags = torch.cat([in_view, in_view.new_zeros(1)])  # the last for those that are gone
        return flags.index_fill_(0, self.row_of_number[self.left_out[view].long()], False)[:-1]

    def probe(self, view: int, num_seen: int) -> Float[Tensor, "seen 1"] | None:
        """Ones to blend along where a view looks at everything; collects what each fills."""
        if not self.is_due(view):
            return None
        return torch.ones(num_seen, 1, device=self.number.device, requires_grad=True)

    def learn(
        self, view: int, rows: Int[Tensor, " seen"], probe: Float[Tensor, "seen 1"] | None
    ) -> None:
        """Take up what the probe of a look at these rows collected; None was another look."""
        self.looks[view] = self.looks.get(view, 0) + 1
        if probe is None:
            return
        if probe.grad is None:
            raise AssertionError("the probe took no part in the loss")
        is_hidden = self._in_view.pop(view)[rows] & (probe.grad[:, 0] < PROBE * LEAST_PX)
        self.left_out[view] = self.number[rows[is_hidden]]

    def follow(self, kept: Int[Tensor, " kept"], num_added: int) -> None:
        """Take up a change of the set: rows kept, in order, then fresh ones."""
        device, first = self.number.device, len(self.row_of_number)
        fresh = torch.arange(first, first + num_added, dtype=torch.int32, device=device)
        self.number = torch.cat([self.number[kept], fresh])
        num_gaussians = len(self.number)
        self.row_of_number = torch.full((first + num_added,), num_gaussians, device=device)
        rows = torch.arange(num_gaussians, device=device)
        self.row_of_number.scatter_(0, self.number.long(), rows)

    def tensors(self) -> dict[str, Tensor]:
        """State to be kept in a checkpoint."""
        lists = list(self.left_out.values())
        return {
            "number": self.number,
            "row_of_number": self.row_of_number,
            "views": torch.tensor(list(self.left_out), dtype=torch.int64),
            "looks": torch.tensor([self.looks[view] for view in self.left_out], dtype=torch.int64),
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
            row_of_number=tensors["row_of_number"].to(device),
            left_out={view: own.clone() for view, own in zip(views, lists, strict=True)},
            looks=dict(zip(views, looks, strict=True)),
        )


def probed(splat: SplatImage) -> Float[Tensor, ""]:
    """The term of the loss from which a probe, the last channel blended, collects."""
    return PROBE * splat.features[..., -1].sum()
