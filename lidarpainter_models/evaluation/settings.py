"""How fitted scenes are judged; read without tensors."""

from dataclasses import dataclass, field
from pathlib import Path

from lidarpainter_models.conditioning.settings import ConditionConfig
from lidarpainter_models.errors import ConfigError
from lidarpainter_models.geometry.shifts import Shift
from lidarpainter_models.metrics.lpips_files import LpipsFiles
from lidarpainter_models.observations.settings import ObservationConfig

SCORED_SHIFTS = (
    Shift(lateral_m=2.0),
    Shift(lateral_m=-2.0),
    Shift(lateral_m=3.0),
    Shift(lateral_m=-3.0),
    Shift(up_m=1.5),
)
"""The paper's trajectories: 2 m and 3 m to both sides, 1.5 m up."""


@dataclass(frozen=True, kw_only=True)
class ScoringConfig:
    """Which views and trajectories are judged."""

    shifts: tuple[Shift, ...] = SCORED_SHIFTS
    """Where the recorded cameras are moved to, to be judged there."""
    most_views: int = 48
    """Held-out views that are judged, evenly over cameras and time, so that judging does not grow
    with the log; 0 judges all."""

    def __post_init__(self) -> None:
        """Refuse a number that is none of views."""
        if self.most_views < 0:
            raise ConfigError(f"scoring.most_views must not be negative, got {self.most_views}")


@dataclass(frozen=True, slots=True, kw_only=True)
class EvaluationConfig:
    """How a fitted scene is judged."""

    observation: ObservationConfig
    scoring: ScoringConfig
    conditions: ConditionConfig
    feature_weights: Path | None = None
    """SqueezeNet 1.1 weights for the feature distance; None leaves it out."""
    lpips: LpipsFiles = field(default_factory=LpipsFiles)
    """Weights for LPIPS; without both files it is left out."""
    inception: Path | None = None
    """Inception's weights for FID and KID; None leaves them out."""

    @property
    def weight_files(self) -> dict[str, Path]:
        """Files that the perceptual distances depend on, by the part they play."""
        files = {"features": self.feature_weights, "inception": self.inception}
        return {n: path for n, path in files.items() if path is not None} | self.lpips.named
