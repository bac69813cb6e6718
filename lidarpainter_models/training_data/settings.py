"""How pairs are made, from which fits; read without tensors."""

from dataclasses import dataclass, field

from lidarpainter_models.conditioning.settings import ConditionConfig
from lidarpainter_models.errors import ConfigError
from lidarpainter_models.gaussians.fitting.config import (
    DensificationConfig,
    FitConfig,
    RefinementConfig,
)
from lidarpainter_models.gaussians.initialisation.settings import InitialisationConfig
from lidarpainter_models.observations.settings import ObservationConfig

AS_GIVEN = RefinementConfig(cameras=False, actors=False)
"""Poses are not refined: those given are the best known, and the truth stands in their frame."""

WEAK_START = 55_000
"""Gaussians that a fit stopped early starts with, more than it ends with."""


def weak_fit(steps: int = 250, *, budget: int = 50_000) -> FitConfig:
    """A fit stopped early, on poses that are taken as they are."""
    return FitConfig(
        steps=steps,
        refinement=AS_GIVEN,
        initialisation=InitialisationConfig(num_gaussians=WEAK_START),
        densification=DensificationConfig(budget=budget),
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class HarvestConfig:
    """How pairs are made from a fit."""

    observations: ObservationConfig = field(default_factory=ObservationConfig)
    conditions: ConditionConfig = field(default_factory=ConditionConfig)
    corrupted_per_view: int = 1
    """Pairs with damaged Gaussians beside the one that is as the fit left it."""
    reference_fit: FitConfig = field(default_factory=lambda: FitConfig(steps=1200))
    """The long fit to all training views whose refined poses the weak ones are judged at."""
    seed: int = 0

    def __post_init__(self) -> None:
        if self.corrupted_per_view < 0:
            raise ConfigError(f"corrupted_per_view must be >= 0, got {self.corrupted_per_view}")


@dataclass(frozen=True, slots=True, kw_only=True)
class StreetPlan:
    """One fit to a street, and how many views of it become pairs."""

    fit: FitConfig = field(default_factory=weak_fit)
    split: str = "alternate"
    """Its training frames are fitted."""
    cameras: tuple[str, ...] = ("front_camera",)
    """Cameras fitted; the first is the one that is shifted."""
    num_views: int = 20

    def __post_init__(self) -> None:
        if not self.cameras or self.num_views < 1:
            raise ConfigError("a street plan needs a camera and at least one view")


def default_street_plans() -> tuple[StreetPlan, ...]:
    """A fit stopped early, one nearly done, and one that has to look ahead of what it saw."""
    return (
        StreetPlan(fit=weak_fit(300), num_views=14),
        StreetPlan(fit=weak_fit(1200, budget=80_000), num_views=36),
        StreetPlan(fit=weak_fit(700, budget=70_000), split="forward:17:8", num_views=16),
    )
