"""Adam for everything that a fit changes, with rows that come and go.

Centres move in units of their Gaussian's own size: one learning rate then suits a pebble and a
far tower. Pose corrections step only when their view is drawn (a dense Adam would let them drift
on momentum for the dozen steps in between). Rates fall exponentially over the fit.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.optim.adam import adam

from lidarpainter_models.gaussians.gaussian_set import PARAMETERS, GaussianSet

LEAST_COLOUR_GRADIENT = 1e-7
"""Adam's epsilon for colours. The loss is a mean over the picture, so a colour's gradient is the
share of the picture that its Gaussian fills. One that the recorded views barely show gets less than
a whole step: Adam's normalisation would drive its colour by noise, and from the next lane it is in
full view. Shapes do not need it; there it costs sharpness.
"""
LEAST_SHAPE_GRADIENT = 1e-15
COLOURS = ("sh_dc", "sh_rest")


@dataclass(frozen=True, slots=True, kw_only=True)
class LearningRates:
    """First and last step sizes; each falls exponentially from the one to the other."""

    means: tuple[float, float] = (0.03, 0.002)
    """In standard deviations of the Gaussian (mean of its two longer axes)."""
    rotation_wxyz: tuple[float, float] = (2e-3, 4e-4)
    """Quaternion units."""
    log_scale: tuple[float, float] = (1e-2, 2e-3)
    """Logarithm of metres."""
    opacity_logit: tuple[float, float] = (3e-2, 1e-2)
    """Logits."""
    sh_dc: tuple[float, float] = (6e-3, 1e-3)
    """Harmonics; a colour changes by 0.28 of it."""
    sh_rest: tuple[float, float] = (6e-4, 2e-4)
    """Harmonics of degree 1 and more."""
    camera_rotation_rad: tuple[float, float] = (3e-4, 3e-5)
    """A pixel of a 480-pixel picture is about 2e-3 rad."""
    camera_translation_m: tuple[float, float] = (3e-3, 3e-4)
    """Recorded positions are good to centimetres."""
    actor_rotation_rad: tuple[float, float] = (2e-3, 2e-4)
    """Boxes are drawn by hand: a degree off is common."""
    actor_translation_m: tuple[float, float] = (1e-2, 1e-3)
    """Boxes are drawn by hand: a decimetre off is common."""
    exposure: tuple[float, float] = (2e-3, 2e-4)
    """Entries of a camera's colour matrix."""

    def at(self, name: str, fraction: float) -> float:
        """The rate of one kind after a fraction of the fit."""
        first, last = getattr(self, name)
        return first * (last / first) ** min(max(fraction, 0.0), 1.0)


class RowAdam:
    """Adam (Kingma and Ba, 2015) on a table whose rows have their own step sizes and counts.

    A row whose gradient is exactly zero is left alone: value, moments and count.
    """

    def __init__(self, table: Tensor, *, betas: tuple[float, float] = (0.9, 0.99)) -> None:
        """Start with empty moments; rows are the first dimension (or the first two, flattened)."""
        self.betas = betas
        self.first = torch.zeros_like(table)
        self.second = torch.zeros_like(table)
        self.count = torch.zeros(table.shape[0], dtype=torch.int64)

    def step(self, table: Tensor, gradient: Tensor, rate: Float[Tensor, "columns"]) -> None:
        """One step in place on the rows with a gradient; `rate` is per column."""
        beta1, beta2 = self.betas
        rows = gradient.abs().sum(dim=1).nonzero()[:, 0]
        if rows.numel() == 0:
            return
        g = gradient[rows]
        self.count[rows] += 1
        count = self.count[rows, None].to(g.dtype)
        first = beta1 * self.first[rows] + (1 - beta1) * g
        second = beta2 * self.second[rows] + (1 - beta2) * g * g
        self.first[rows], self.second[rows] = first, second
        spread = (second / (1 - beta2**count)).sqrt() + 1e-15
        with torch.no_grad():
            table[rows] -= rate * (first / (1 - beta1**count)) / spread

    def tensors(self) -> dict[str, Tensor]:
        """State to be kept in a checkpoint."""
        return {"first": self.first, "second": self.second, "count": self.count}

    def load(self, tensors: dict[str, Tensor]) -> None:
        """Take over kept state."""
        self.first, self.second = tensors["first"].clone(), tensors["second"].clone()
        self.count = tensors["count"].clone()


class GaussianAdam:
    """Adam over the parameters of a Gaussian set.

    Moments fade for rows out of view, as in Kerbl et al. (2023): skipping them costs more than it
    saves and changes the result.
    """

    def __init__(self, gaussians: GaussianSet, rates: LearningRates) -> None:
        """Start with empty moments."""
        self.rates = rates
        self.first = {name: torch.zeros_like(p) for name, p in gaussians.columns().items()}
        self.second = {name: torch.zeros_like(p) for name, p in gaussians.columns().items()}
        for moments in (self.first, self.second):
            del moments["body_index"]
        self.steps = {name: torch.zeros(()) for name in PARAMETERS}

    def step(self, gaussians: GaussianSet, fraction: float) -> None:
        """Move every parameter that has a gradient, in place, and drop the gradients."""
        with torch.no_grad():
            log_scale = gaussians.log_scale
            longer = log_scale.sum(dim=1, keepdim=True) - log_scale.amin(dim=1, keepdim=True)
            sigma_m = (longer / 2).exp()
            for name, parameter in gaussians.parameters().items():
                gradient = parameter.grad
                if gradient is None:
                    continue
                rate = self.rates.at(name, fraction)
                if name == "means":
                    self._step_scaled(parameter, gradient, rate, sigma_m)
                else:
                    self._step_fused(name, parameter, gradient, rate)
                parameter.grad = None

    def _step_fused(self, name: str, parameter: Tensor, gradient: Tensor, rate: float) -> None:
        adam(
            [parameter],
            [gradient],
            [self.first[name]],
            [self.second[name]],
            [],
            [self.steps[name]],
            fused=True,
            amsgrad=False,
            beta1=0.9,
            beta2=0.99,
            lr=rate,
            weight_decay=0.0,
            eps=LEAST_COLOUR_GRADIENT if name in COLOURS else LEAST_SHAPE_GRADIENT,
            maximize=False,
        )

    def _step_scaled(
        self,
        means: Tensor,
        gradient: Tensor,
        rate: float,
        sigma_m: Float[Tensor, "gaussians 1"],
    ) -> None:
        self.steps["means"] += 1
        count = float(self.steps["means"])
        first, second = self.first["means"], self.second["means"]
        first.lerp_(gradient, 0.1)
        second.mul_(0.99).addcmul_(gradient, gradient, value=0.01)
        spread = (second / (1 - 0.99**count)).sqrt_().add_(LEAST_SHAPE_GRADIENT)
        means.addcdiv_(first * sigma_m, spread, value=-rate / (1 - 0.9**count))

    def rebuild(self, kept: Int[Tensor, " kept"], num_added: int) -> None:
        """Follow a change of the set: rows kept, then fresh rows with empty moments."""
        for moments in (self.first, self.second):
            for name, value in moments.items():
                fresh = value.new_zeros((num_added, *value.shape[1:]))
                moments[name] = torch.cat([value[kept], fresh])

    def tensors(self) -> dict[str, Tensor]:
        """State to be kept in a checkpoint."""
        kept = {f"first.{name}": value for name, value in self.first.items()}
        kept |= {f"second.{name}": value for name, value in self.second.items()}
        return kept | {f"steps.{name}": value for name, value in self.steps.items()}

    def load(self, tensors: dict[str, Tensor]) -> None:
        """Take over kept state."""
        for name in PARAMETERS:
            self.first[name] = tensors[f"first.{name}"].clone()
            self.second[name] = tensors[f"second.{name}"].clone()
            self.steps[name] = tensors[f"steps.{name}"].clone()
