"""Adam over the Gaussians of a fit, at a cost that follows the Gaussians in view.

What is out of view has no gradient, but its moments fade and it still moves a little, as in the
dense Adam of Kerbl et al. (2023). Rows are left as they are until they are wanted and then moved by
all the steps they missed at once (`adam_kernels`). Whatever else reads the whole set asks
`catch_up` first. Centres move in units of their Gaussian's own size.
"""

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from lidarpainter_models.gaussians.fitting.optimiser import LearningRates
from lidarpainter_models.gaussians.model.gaussian_set import PARAMETERS, GaussianSet
from lidarpainter_models.gaussians.model.seen_gaussians import SeenGaussians
from lidarpainter_models.kernels.sparse_adam import cpu as adam_kernels

LEAST_COLOUR_GRADIENT = 1e-7
"""Adam's epsilon for colours. The loss is a mean over the image, so a colour's gradient is the
share of the image that its Gaussian fills. One that the recorded views barely show gets less than
a whole step: Adam's normalisation would drive its colour by noise, and from the next lane it is in
full view. Shapes do not need it; there it costs sharpness.
"""
LEAST_SHAPE_GRADIENT = 1e-15
COLOURS = ("sh_dc", "sh_rest")


class GaussianAdam:
    """Adam (Kingma and Ba, 2015) over the parameters of a Gaussian set."""

    def __init__(self, gaussians: GaussianSet, rates: LearningRates) -> None:
        """Start with empty moments."""
        self.rates = rates
        widths = [value.shape[1:].numel() for value in gaussians.parameters().values()]
        widths[-1] += -sum(widths) % adam_kernels.VECTOR  # no vector loop ends in single numbers
        self._kind_of_column = np.repeat(np.arange(len(PARAMETERS)), widths)
        eps = [
            LEAST_COLOUR_GRADIENT if name in COLOURS else LEAST_SHAPE_GRADIENT
            for name in PARAMETERS
        ]
        self._eps = np.array(eps, np.float32)[self._kind_of_column]
        self.first = torch.zeros(len(gaussians), sum(widths))
        """Moments, a row per Gaussian in the order of `PARAMETERS`."""
        self.second = torch.zeros(len(gaussians), sum(widths))
        self.last = torch.zeros(len(gaussians), dtype=torch.int32)
        """The step after which a row was left; its parameters and moments are those of then."""
        self.count = 0
        self._missed: list[list[float]] = []  # rates of the steps since all rows were caught up

    def seen(self, gaussians: GaussianSet, rows: Int[Tensor, " seen"]) -> SeenGaussians:
        """The given rows as they are now, ready to collect gradients."""
        seen = SeenGaussians.room(gaussians, rows)
        adam_kernels.present(
            _kept(gaussians),
            self.first.numpy(),
            self.second.numpy(),
            self.last.numpy(),
            rows.numpy(),
            self._nodes(rows.numpy()),
            self.count,
            self._eps,
            _parameters(seen.values()),
        )
        return seen

    def step(self, gaussians: GaussianSet, seen: SeenGaussians, fraction: float) -> None:
        """Move every row that collected a gradient, in place, after a fraction of the fit."""
        rates = [self.rates.at(name, fraction) for name in PARAMETERS]
        self.count += 1
        self._missed.append(rates)
        adam_kernels.step_rows(
            _kept(gaussians),
            self.first.numpy(),
            self.second.numpy(),
            self.last.numpy(),
            seen.rows.numpy(),
            _parameters(seen.values()),
            _parameters(seen.gradients()),
            np.array(rates)[self._kind_of_column],
            self.count,
            self._eps,
        )

    def catch_up(self, gaussians: GaussianSet) -> None:
        """Bring the whole set up to date, in place."""
        if self._missed:
            adam_kernels.catch_up(
                _kept(gaussians),
                self.first.numpy(),
                self.second.numpy(),
                self.last.numpy(),
                self._nodes(np.arange(len(gaussians))),
                self.count,
                self._eps,
            )
        self._missed = []

    def _nodes(self, rows: np.ndarray) -> adam_kernels.Nodes:
        """What stands for the steps that these rows missed."""
        missed = np.array(self._missed).reshape(-1, len(PARAMETERS))
        return adam_kernels.missed_nodes(
            self.last.numpy(), rows, missed, self._kind_of_column, self.count
        )

    def rebuild(self, kept: Int[Tensor, " kept"], num_added: int) -> None:
        """Follow a change of a set that was caught up: rows kept, then rows with empty moments."""
        fresh = self.first.new_zeros((num_added, self.first.shape[1]))
        self.first = torch.cat([self.first[kept], fresh])
        self.second = torch.cat([self.second[kept], fresh])
        self.last = torch.full((len(kept) + num_added,), self.count, dtype=torch.int32)

    def tensors(self) -> dict[str, Tensor]:
        """State to be kept in a checkpoint, beside the parameters as they stand in the set.

        Rows are not caught up for it: the fit that goes on must not differ from one that was
        never interrupted.
        """
        return {
            "first": self.first,
            "second": self.second,
            "last": self.last,
            "count": torch.tensor(self.count),
            "missed": torch.tensor(self._missed, dtype=torch.float64),
        }

    def load(self, tensors: dict[str, Tensor]) -> None:
        """Take over kept state."""
        self.first, self.second = tensors["first"].clone(), tensors["second"].clone()
        self.last, self.count = tensors["last"].clone(), int(tensors["count"])
        self._missed = tensors["missed"].tolist()


def _parameters(columns: dict[str, Tensor]) -> adam_kernels.Parameters:
    """The compiled code's view of leaves, or of their gradients."""
    arrays = {name: value.contiguous().numpy() for name, value in columns.items()}
    harmonics = _rows(arrays.pop("sh"))
    return adam_kernels.Parameters(
        **arrays, harmonics=harmonics, more_harmonics=np.empty((len(harmonics), 0), np.float32)
    )


def _kept(gaussians: GaussianSet) -> adam_kernels.Parameters:
    """The compiled code's view of a whole set; it writes into the set's memory."""
    columns = {name: value.detach().numpy() for name, value in gaussians.parameters().items()}
    harmonics, more_harmonics = _rows(columns.pop("sh_dc")), _rows(columns.pop("sh_rest"))
    return adam_kernels.Parameters(**columns, harmonics=harmonics, more_harmonics=more_harmonics)


def _rows(harmonics: Float[np.ndarray, "rows harmonics 3"]) -> Float[np.ndarray, "rows numbers"]:
    return harmonics.reshape(len(harmonics), harmonics.shape[1] * 3)
