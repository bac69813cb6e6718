"""Every setting of a fit, each with its reason; read without tensors."""

import math
from dataclasses import dataclass, field, replace

from lidarpainter_models.errors import ConfigError
from lidarpainter_models.gaussians.fitting.learning_rates import LearningRates
from lidarpainter_models.gaussians.initialisation.settings import InitialisationConfig

START_SHARE = 0.6875
"""Part of the most Gaussians that a fit starts with; the rest is grown where images are wrong (a
real log lost 0.3 dB without)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RefinementConfig:
    """Which poses and colours of the recording may be corrected."""

    cameras: bool = True
    """Refine the pose of every training view (+0.9 dB on a real log); rounds hold it."""
    actors: bool = True
    """Refine the pose of every actor over time (+1.2 dB inside boxes)."""
    exposure: bool = False
    """Fit a colour matrix per camera even if there is one camera only."""
    lamps: bool = True
    """Look for lamps that go on and off (`lamp_search`) unless there are some; rounds do not."""
    start_step: int = 100
    """Before this the image is too coarse to align anything."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FitLossWeights:
    """How much each part of the loss of a fit counts; see `loss`."""

    ssim: float = 0.2
    """Weight of 1 - SSIM beside the mean absolute difference."""
    perceptual: float = 0.0
    """Weight of the perceptual distance, where one is given to the fit."""
    sky: float = 0.05
    """Weight of the clear-sky term, on painted views of its part where LiDAR hit something."""
    actors: float = 0.1
    """Weight of the term that keeps actors inside their boxes."""
    depth: float = 0.05
    """Weight of the LiDAR depth term."""


@dataclass(frozen=True, slots=True, kw_only=True)
class GuidanceConfig:
    """How painted views take part."""

    probability: float = 1.0
    """Probability of adding one painted view to a step (the paper's p_novel, 0.4). With 0.5 the
    neighbouring lanes of streets had 0.05 to 0.16 dB less."""
    weight: float = 1.0
    """Weight of a painted view's loss (the paper's lambda_novel is 0.2, for pixels that all count
    fully; here most count a tenth)."""
    ssim: float = 0.1
    """Weight of 1 - SSIM in a painted view's loss, as in the paper."""
    perceptual: float = 0.0
    """Weight of the perceptual distance in a painted view's loss, where one is given to the fit
    (1 in the paper)."""
    depth: float = 0.02
    """Weight of the LiDAR depth term on painted views: a painted guess in a hole would otherwise
    pull surfaces off their LiDAR depth. More costs recorded views where images and LiDAR disagree
    (docs/decisions/what-guides-a-fit.md)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class EffortConfig:
    """How much a fit spends on what the views show; see `plan`."""

    looks: float = 300.0
    """Steps for every view's worth of new surface. More of them sharpen the recorded views and cost
    the neighbouring lanes (docs/decisions/length-of-a-fit.md)."""
    gaussians_per_pixel: float = 0.23
    """Most Gaussians for a pixel of surface with the detail of a typical street (`SeenSurface`):
    more sharpen one camera by a little, and six cameras not at all (docs/measuring.md)."""

    def __post_init__(self) -> None:
        """Refuse an effort that comes to nothing."""
        if not (self.looks > 0 and self.gaussians_per_pixel > 0):
            raise ConfigError(
                f"effort.looks and effort.gaussians_per_pixel must be positive, got {self.looks} "
                f"and {self.gaussians_per_pixel}"
            )


@dataclass(frozen=True, slots=True, kw_only=True)
class DensificationConfig:
    """When and how far the number of Gaussians changes."""

    budget: int = 0
    """The most Gaussians of a fit; 0 follows the effort of the fit."""
    start: float = 0.1
    """Fraction of the fit after which splitting begins: gradients must mean something."""
    stop: float = 0.6
    """Fraction of the fit after which splitting ends: new Gaussians need time to settle."""
    every: int = 50
    """Steps between two splittings; several passes over the views of a short log."""

    def __post_init__(self) -> None:
        """Refuse a schedule that runs backwards."""
        if not 0 <= self.start <= self.stop <= 1 or self.every < 1:
            raise ConfigError(
                f"densification needs 0 <= start <= stop <= 1 and every >= 1, got start "
                f"{self.start}, stop {self.stop}, every {self.every}"
            )
        if self.budget < 0:
            raise ConfigError(f"densification.budget must not be negative, got {self.budget}")

    def allowed_now(self, num_gaussians: int, fraction: float, steps: int) -> int:
        """Return how many Gaussians there may be after a splitting: even steps up to the budget.

        `fraction` is the part that is done, 0 to 1, of a fit of so many steps.
        """
        first = min(num_gaussians, self.budget)
        progress = (fraction - self.start) / max(self.stop - self.start, 1e-9)
        rounds_left = max((1 - progress) * (self.stop - self.start), 0) * steps
        rounds_left = 1 + rounds_left // self.every
        return first + math.ceil((self.budget - first) / rounds_left)


@dataclass(frozen=True, slots=True, kw_only=True)
class FitConfig:
    """How a Gaussian scene is fitted; the defaults suit two CPU cores."""

    effort: EffortConfig = field(default_factory=EffortConfig)
    steps: int = 0
    """Optimiser steps, one recorded view each; 0 follows the effort."""
    half_resolution: float = 0.3
    """First part of the steps at half the image size: a quarter of the pixels."""
    seed: int = 0
    """Seed of the order in which the fit sees its views."""
    initialisation: InitialisationConfig = field(default_factory=InitialisationConfig)
    densification: DensificationConfig = field(default_factory=DensificationConfig)
    learning_rates: LearningRates = field(default_factory=LearningRates)
    losses: FitLossWeights = field(default_factory=FitLossWeights)
    refinement: RefinementConfig = field(default_factory=RefinementConfig)
    guidance: GuidanceConfig = field(default_factory=GuidanceConfig)
    log_every: int = 50
    """Steps between two entries of the history."""
    memory_bytes: int | None = None
    """Most memory of the whole process, on a CPU: fewer Gaussians are made where more would be
    taken. None sets no limit."""
    time_limit_s: float | None = None
    """Most wall time of the steps: as many are made as there is time for, and the schedules are
    those of so many. None sets no limit."""

    def most_steps(self, num_views: float) -> float:
        """Return the steps that are set, or those that follow if every view is new all over."""
        return self.steps or self.effort.looks * num_views

    @property
    def weighs_perceptual(self) -> bool:
        """Whether a perceptual distance takes part, which must then be given."""
        return max(self.losses.perceptual, self.guidance.perceptual) > 0

    def __post_init__(self) -> None:
        """Refuse settings that make no fit."""
        if self.steps < 0 or self.log_every < 1:
            raise ConfigError(
                f"steps must not be negative and log_every positive, got {self.steps} and "
                f"{self.log_every}"
            )
        for name in ("memory_bytes", "time_limit_s"):
            value = getattr(self, name)
            if value is not None and value <= 0:
                raise ConfigError(f"{name} must be positive, got {value}")
        if not 0 <= self.half_resolution <= 1:
            raise ConfigError(f"half_resolution must be in [0, 1], got {self.half_resolution}")
        if not 0 <= (value := self.guidance.probability) <= 1:
            raise ConfigError(f"guidance.probability must be in [0, 1], got {value}")


def continuation(
    config: FitConfig, *, looks: float | None = None, guidance: GuidanceConfig | None = None
) -> FitConfig:
    """Return how a fit is continued from a fitted scene, for so many looks.

    Full images and actors free to move from the first step; growth and rates as in the first fit.
    Rates started lower held nothing better and took in a fifth less of what was painted. Cameras
    stay where the first fit has them: what they still move is noise, which painted views, seen from
    where they were, pay for (docs/decisions/rates-of-learning.md).
    """
    return replace(
        config,
        effort=replace(config.effort, looks=looks or config.effort.looks),
        steps=0,
        half_resolution=0.0,
        refinement=replace(config.refinement, cameras=False, lamps=False, start_step=0),
        guidance=guidance or config.guidance,
    )
