"""The noise schedule of SD-Turbo and the closed form of its one denoising step.

A DDPM step (Ho et al., 2020, equation 7) in the form that names the clean latent x0:

    x0   = (z - sqrt(1 - abar_t) * eps) / sqrt(abar_t)
    mean = c0 * x0 + ct * z
    c0   = sqrt(abar_prev) * beta_t / (1 - abar_t),     beta_t  = 1 - alpha_t
    ct   = sqrt(alpha_t) * (1 - abar_prev) / (1 - abar_t),  alpha_t = abar_t / abar_prev

with abar cumulative and alpha, beta of the step from `previous` to `timestep`. Where one step goes
all the way (abar_prev = 1), c0 = 1, ct = 0 and no noise is added: the result is x0 itself.

The paper prints `sqrt(alpha_{t-1}) beta_t / beta_{t-1} Z + sqrt(alpha_t) beta_{t-1} / beta_t z`.
This is the same step with two slips. Its first denominator should be the cumulative beta_t
(`1 - abar_t`): as printed it divides by zero in the last step. And Z is the network's prediction of
the *noise*, where x0 belongs. Read literally with the betas of single steps it is nearly `Z + z`, a
residual in the latent; that reading is kept as the option `residual`.

At t = 999 x0 = 14.65 z - 14.61 eps, so an eps rounded to bfloat16 alone puts an error of 0.024 on
the latent: the step is always taken in float32 (at t = 199 x0 = 1.15 z - 0.57 eps).
"""

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

from jaxtyping import Float
from torch import Tensor

from lidarpainter_models.errors import ConfigError

Denoise = Literal["posterior", "residual"]
LAST_STEP = -1
"""The time before the first: a clean latent."""


@dataclass(frozen=True, slots=True, kw_only=True)
class NoiseSchedule:
    """Betas whose square roots rise evenly (`scaled_linear`); the defaults are SD-Turbo's."""

    first_beta: float = 0.00085
    last_beta: float = 0.012
    num_steps: int = 1000

    def __post_init__(self) -> None:
        """Refuse schedules that are none."""
        if not 0 < self.first_beta <= self.last_beta < 1 or self.num_steps < 2:
            raise ConfigError(
                "a noise schedule needs 0 < first_beta <= last_beta < 1 and two steps, got "
                f"{self.first_beta}, {self.last_beta}, {self.num_steps}"
            )

    def signal_share(self, timestep: int) -> float:
        """The cumulative alpha-bar of a time: the share of signal power; 1 at `LAST_STEP`.

        Raises:
            ConfigError: the schedule has no such time.
        """
        if not LAST_STEP <= timestep < self.num_steps:
            raise ConfigError(f"timestep must be in [-1, {self.num_steps - 1}], got {timestep}")
        return _signal_shares(self)[timestep + 1]


@lru_cache(maxsize=8)
def _signal_shares(schedule: NoiseSchedule) -> tuple[float, ...]:
    first, last = math.sqrt(schedule.first_beta), math.sqrt(schedule.last_beta)
    shares = [1.0]
    for step in range(schedule.num_steps):
        beta = (first + (last - first) * step / (schedule.num_steps - 1)) ** 2
        shares.append(shares[-1] * (1 - beta))
    return tuple(shares)


@dataclass(frozen=True, slots=True, kw_only=True)
class DenoisingStep:
    """The factors of one step; see the module for the letters."""

    signal: float
    """sqrt(abar_t)."""
    noise: float
    """sqrt(1 - abar_t)."""
    clean: float
    """c0, of the clean latent."""
    current: float
    """ct, of the latent before the step."""
    deviation: float
    """Standard deviation of the noise that sampling would add, 0 in a last step. Not added here."""


def denoising_step(
    timestep: int, previous: int = LAST_STEP, schedule: NoiseSchedule | None = None
) -> DenoisingStep:
    """The factors of the step from `timestep` down to `previous`.

    Raises:
        ConfigError: the times are not in the schedule, or not in this order.
    """
    schedule = schedule or NoiseSchedule()
    if not previous < timestep:
        raise ConfigError(f"a step goes down in time, got {timestep} to {previous}")
    here, there = schedule.signal_share(timestep), schedule.signal_share(previous)
    alpha = here / there
    variance = (1 - alpha) * (1 - there) / (1 - here)
    return DenoisingStep(
        signal=math.sqrt(here),
        noise=math.sqrt(1 - here),
        clean=math.sqrt(there) * (1 - alpha) / (1 - here),
        current=math.sqrt(alpha) * (1 - there) / (1 - here),
        deviation=math.sqrt(variance),
    )


def denoise(
    latent: Float[Tensor, "batch channels height width"],
    predicted: Float[Tensor, "batch channels height width"],
    step: DenoisingStep,
    kind: Denoise = "posterior",
) -> Float[Tensor, "batch channels height width"]:
    """Take one step in float32; nothing random is added.

    The kind `posterior` is the mean above; `residual` adds the prediction to the latent.
    """
    latent, predicted = latent.float(), predicted.float()
    if kind == "residual":
        return latent + predicted
    clean = (latent - step.noise * predicted) / step.signal
    if step.current == 0:
        return step.clean * clean
    return step.clean * clean + step.current * latent
