"""How fitted scenes are judged; read without tensors."""

from dataclasses import dataclass, field
from pathlib import Path

from lidarpainter_models.conditioning.settings import ConditionConfig
from lidarpainter_models.geometry.shifts import Shift
from lidarpainter_models.metrics.lpips_files import LpipsFiles
from lidarpainter_models.observations.settings import ObservationConfig

JUDGED_SHIFTS = (
    Shift(lateral_m=2.0),
    Shift(lateral_m=-2.0),
    Shift(lateral_m=3.0),
    Shift(lateral_m=-3.0),
    Shift(up_m=1.5),
)
"""The paper's trajectories: 2 m and 3 m to both sides, 1.5 m up."""


@dataclass(frozen=True, kw_only=True)
class ScoringConfig:
    """Which trajectories are judged."""

    shifts: tuple[Shift, ...] = JUDGED_SHIFTS
    """Where the recorded cameras are moved to, to be judged there."""


@dataclass(frozen=True, slots=True, kw_only=True)
class JudgeConfig:
    """How a fitted scene is judged."""

    observation: ObservationConfig
    scoring: ScoringConfig
    conditions: ConditionConfig
    feature_weights: Path | None = None
    """SqueezeNet 1.1 weights for the feature distance; None leaves it out."""
    lpips: LpipsFiles = field(default_factory=LpipsFiles)
    """Weights for LPIPS; without both files it is left out."""

    @property
    def weight_files(self) -> dict[str, Path]:
        """Files that the perceptual distances depend on, by the part they play."""
        features = {} if self.feature_weights is None else {"features": self.feature_weights}
        return features | self.lpips.named
