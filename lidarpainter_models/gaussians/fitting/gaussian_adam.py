"""Adam over the Gaussians of a fit, at a cost that follows the Gaussians in view.

What is out of view has no gradient, but its moments fade and it still moves a little, as in the
dense Adam of Kerbl et al. (2023). Rows are left as they are until they are wanted and then moved by
all the steps they missed at once (`sparse_adam`). Whatever else reads the whole set asks
`catch_up` first. Centres move in units of their Gaussian's own size.
"""

import math

import torch
from jaxtyping import Int
from torch import Tensor

from lidarpainter_models.gaussians.fitting.learning_rates import LearningRates
from lidarpainter_models.gaussians.model.gaussian_set import PARAMETERS, SH_CONSTANT, GaussianSet
from lidarpainter_models.gaussians.model.seen_gaussians import SeenGaussians
from lidarpainter_models.kernels.frustum_culling import MOST_SIGMAS
from lidarpainter_models.kernels.sparse_adam import (
    MOST_UNITS,
    AdamState,
    Parameters,
    catch_up,
    present_rows,
    step_rows,
)

COLOUR_PIXELS = 0.5
"""A colour takes about half a step where its Gaussian fills this much of a pixel of a view. Adam's
normalisation would drive one that the recorded views barely show as fast as all others, by noise,
and from the next lane it is in full view. Shapes do not need it; there it costs sharpness.
"""
LEAST_SHAPE_GRADIENT = 1e-15
COLOURS = ("sh_dc", "sh_rest")


def most_sigmas(rates: LearningRates) -> float:
    """How far a Gaussian that is not stepped reaches at most, in its deviations when it was."""
    growth = math.exp(MOST_UNITS * max(rates.log_scale))
    return 1.001 * growth * (MOST_SIGMAS + MOST_UNITS * max(rates.means))


class GaussianAdam:
    """Adam (Kingma and Ba, 2015) over the parameters of a Gaussian set."""

    def __init__(
        self, gaussians: GaussianSet, rates: LearningRates, pixels_per_view: float
    ) -> None:
        """Start with empty moments; views have so many pixels on average."""
        least_colour_gradient = COLOUR_PIXELS * SH_CONSTANT / (3 * pixels_per_view)
        self.rates = rates
        self.state = AdamState.empty(
            len(gaussians),
            [value.shape[1:].numel() for value in gaussians.parameters().values()],
            [
                least_colour_gradient if name in COLOURS else LEAST_SHAPE_GRADIENT
                for name in PARAMETERS
            ],
            gaussians.means.device,
        )

    def seen(self, gaussians: GaussianSet, rows: Int[Tensor, " seen"]) -> SeenGaussians:
        """The given rows as they are now, ready to collect gradients."""
        seen = SeenGaussians.room(gaussians, rows)
        present_rows(self.state, _kept(gaussians), rows, _of_seen(seen.values()))
        return seen

    def step(self, gaussians: GaussianSet, seen: SeenGaussians, fraction: float) -> None:
        """Move every row that collected a gradient, in place, after a fraction of the fit."""
        step_rows(
            self.state,
            _kept(gaussians),
            seen.rows,
            _of_seen(seen.values()),
            _of_seen(seen.gradients()),
            [self.rates.at(name, fraction) for name in PARAMETERS],
        )

    def catch_up(self, gaussians: GaussianSet) -> None:
        """Bring the whole set up to date, in place."""
        catch_up(self.state, _kept(gaussians))

    def rebuild(self, kept: Int[Tensor, " kept"], num_added: int) -> None:
        """Follow a change of a set that was caught up: rows kept, then rows with empty moments."""
        state = self.state
        fresh = state.first.new_zeros((num_added, state.first.shape[1]))
        state.first = torch.cat([state.first[kept], fresh])
        state.second = torch.cat([state.second[kept], fresh])
        state.last = state.last.new_full((len(kept) + num_added,), state.count)

    def tensors(self) -> dict[str, Tensor]:
        """State to be kept in a checkpoint, beside the parameters as they stand in the set.

        Rows are not caught up for it: the fit that goes on must not differ from one that was
        never interrupted.
        """
        return {
            "first": self.state.first,
            "second": self.state.second,
            "last": self.state.last,
            "count": torch.tensor(self.state.count),
            "missed": torch.tensor(self.state.missed, dtype=torch.float64),
        }

    def load(self, tensors: dict[str, Tensor]) -> None:
        """Take over kept state."""
        state, device = self.state, self.state.first.device
        state.first, state.second, state.last = (
            tensors[name].to(device, copy=True) for name in ("first", "second", "last")
        )
        state.count = int(tensors["count"])
        state.missed = tensors["missed"].tolist()


def _of_seen(columns: dict[str, Tensor]) -> Parameters:
    """Leaves, or their gradients, as the optimiser sees them."""
    rest = {name: value for name, value in columns.items() if name != "sh"}
    return Parameters(**rest, harmonics=columns["sh"], more_harmonics=columns["sh"][:, :0])


def _kept(gaussians: GaussianSet) -> Parameters:
    """A whole set as the optimiser sees it; it writes into the set's memory."""
    columns = {name: value.detach() for name, value in gaussians.parameters().items()}
    harmonics, more_harmonics = columns.pop("sh_dc"), columns.pop("sh_rest")
    return Parameters(**columns, harmonics=harmonics, more_harmonics=more_harmonics)
