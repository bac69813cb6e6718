"""What the painters' flows are given: frozen models that hold the library's settings as fields."""

from pathlib import Path

from pydantic import BaseModel, ConfigDict, Field, field_validator

from lidarpainter_models.devices import check_device
from lidarpainter_models.evaluation.held_back import FIRST_TRAINING_SEED
from lidarpainter_models.metrics.lpips_files import LpipsFiles
from lidarpainter_models.painter.nano.training import NanoTrainingConfig
from lidarpainter_models.painter.training_jobs import PainterTraining
from lidarpainter_models.synthetic.config import DEFAULT_CAMERAS, SyntheticStreetConfig
from lidarpainter_models.training_data.settings import (
    HarvestConfig,
    StreetPlan,
    default_street_plans,
)


class HarvestParameters(BaseModel):
    """Where pairs come from."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    street_seeds: tuple[int, ...] = ()
    """Synthetic streets to draw and to harvest."""
    street: SyntheticStreetConfig = SyntheticStreetConfig(
        seed=FIRST_TRAINING_SEED, width_px=640, height_px=360, cameras=DEFAULT_CAMERAS[:1]
    )
    """What the streets have in common; each has its own seed. The plans fit the front camera."""
    street_plans: tuple[StreetPlan, ...] = default_street_plans()
    scenes: tuple[str, ...] = ()
    """Stored scenes to harvest, `<dataset>/<sequence>`."""
    split: str = "alternate"
    """Split of the recorded scenes; only their training frames are used."""
    cameras: tuple[str, ...] | None = None
    """Cameras of the recorded scenes; None takes all."""
    harvest: HarvestConfig = HarvestConfig()


class TrainPainterParameters(HarvestParameters):
    """What a painter is trained on, and how."""

    pair_folders: tuple[Path, ...] = ()
    """Pairs that were harvested before."""
    start: Path | None = None
    """Weights to go on from, a name or a file; None starts from nothing."""
    base: str | None = None
    """Model that the one-step painter is trained on; None trains the small painter."""
    training: PainterTraining = NanoTrainingConfig()
    lpips: LpipsFiles = LpipsFiles()
    """Weights for the loss of the one-step painter."""
    device: str = "auto"
    """Where a painter is trained and judged."""
    processes: int = 1
    """In which the one-step painter is trained, each on a GPU of its own."""
    held_back: float = Field(default=0.1, ge=0, lt=1)
    """Share of the true images that are kept from training: the validation split."""
    feature_weights: Path | None = None
    """SqueezeNet 1.1 weights for the feature distance; None leaves it out."""

    _known_device = field_validator("device")(check_device)
