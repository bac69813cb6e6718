"""Every setting of a fit, each with its reason."""

from dataclasses import dataclass, field, replace

from lidarpainter_models.errors import ConfigError
from lidarpainter_models.gaussians.fitting.settings import (
    DensificationConfig,
    FitLossWeights,
    LearningRates,
    ShapeLimits,
)
from lidarpainter_models.gaussians.initialisation.settings import InitialisationConfig

HALF_STEP = 0.6
"""What a step at half the image size costs of one at full size: 0.46 in images 960 pixels wide, in
smaller ones 0.72, as Gaussians cost more than pixels there (docs/decisions/length-of-a-fit.md)."""


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
class GuidanceConfig:
    """How painted views take part."""

    probability: float = 1.0
    """Of adding one painted view to a step (the paper's p_novel, 0.4). Against 0.5 the neighbouring
    lanes of streets gain 0.1 dB, recorded views lose 0.05 to 0.1
    (docs/decisions/what-guides-a-fit.md)."""
    until: float = 0.7
    """Part of the steps that painted views take part in. The last ones fit recorded views alone,
    which halves what painting costs these (docs/decisions/what-guides-a-fit.md)."""
    weight: float = 1.0
    """Of its loss (the paper's lambda_novel, 0.2, changed nothing on short schedules)."""
    ssim: float = 0.1
    """Of 1 - SSIM in its loss, as in the paper."""
    perceptual: float = 0.0
    """Of the perceptual distance in its loss, where one is given to the fit (1 in the paper)."""
    depth: float = 0.01
    """Of the LiDAR depth term on painted views: a painted guess in a hole would otherwise pull
    surfaces off their LiDAR depth."""


@dataclass(frozen=True, slots=True, kw_only=True)
class EffortConfig:
    """How much a fit spends on what the views show; see `planned_fit`."""

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
class FitConfig:
    """How a Gaussian scene is fitted; the defaults suit two CPU cores."""

    effort: EffortConfig = field(default_factory=EffortConfig)
    steps: int = 0
    """Optimiser steps, one recorded view each; 0 follows the effort."""
    half_resolution: float = 0.3
    """First part of the steps at half the image size: a quarter of the pixels."""
    seed: int = 0
    """Of the order of views."""
    initialisation: InitialisationConfig = field(default_factory=InitialisationConfig)
    densification: DensificationConfig = field(default_factory=DensificationConfig)
    learning_rates: LearningRates = field(default_factory=LearningRates)
    losses: FitLossWeights = field(default_factory=FitLossWeights)
    refinement: RefinementConfig = field(default_factory=RefinementConfig)
    shapes: ShapeLimits = field(default_factory=ShapeLimits)
    guidance: GuidanceConfig = field(default_factory=GuidanceConfig)
    log_every: int = 50
    """Steps between two entries of the history."""
    memory_bytes: int | None = None
    """Of the whole process, on a CPU: fewer Gaussians are made where more would be taken. None
    sets no limit."""
    time_limit_s: float | None = None
    """Of the steps, by the clock: as many are made as there is time for, and the schedules are
    those of so many. None sets no limit."""

    def most_steps(self, num_views: float) -> float:
        """Steps that are set, or those that follow if every view is new all over."""
        return self.steps or self.effort.looks * num_views

    def work(self, step: int) -> float:
        """What the first steps cost, in steps at full image size."""
        return step - (1 - HALF_STEP) * min(step, self.half_resolution * self.steps)

    def steps_within(self, work: float, step: int) -> int:
        """How many steps there may be in all, so that those after `step` cost so much `work`.

        `steps` at most; of fewer steps, the part at half size is shorter too.
        """
        half = self.half_resolution
        steps = (work + HALF_STEP * step) / (HALF_STEP * half + 1 - half)
        if steps * half < step:
            steps = step + max(work, 0.0)
        return min(self.steps, int(steps))

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
        for name in ("probability", "until"):
            if not 0 <= (value := getattr(self.guidance, name)) <= 1:
                raise ConfigError(f"guidance.{name} must be in [0, 1], got {value}")


def continuation(
    config: FitConfig,
    *,
    steps: int = 0,
    looks: float | None = None,
    guidance: GuidanceConfig | None = None,
) -> FitConfig:
    """How a fit goes on from a fitted scene, for so many steps or looks.

    Full images and actors free to move from the first step; growth and rates as in the first fit.
    Rates started lower held nothing better and took in a fifth less of what was painted. Cameras
    stay where the first fit has them: what they still move is noise, which painted views, seen from
    where they were, pay for (docs/decisions/rates-of-learning.md).
    """
    return replace(
        config,
        effort=replace(config.effort, looks=looks or config.effort.looks),
        steps=steps,
        half_resolution=0.0,
        refinement=replace(config.refinement, cameras=False, lamps=False, start_step=0),
        guidance=guidance or config.guidance,
    )
