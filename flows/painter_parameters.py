"""What the painters' flows are given, and what the options of a training make of its recipe.

Frozen models hold the library's settings as fields.
"""

from dataclasses import replace
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, Field, field_validator

from lidarpainter_models.devices import check_device
from lidarpainter_models.errors import ConfigError
from lidarpainter_models.evaluation.held_back import FIRST_TRAINING_SEED
from lidarpainter_models.metrics.lpips_files import LpipsFiles
from lidarpainter_models.painter.nano.training import NanoTrainingConfig
from lidarpainter_models.painter.selection import PainterChoice
from lidarpainter_models.painter.training_jobs import PainterTraining, recipe_for
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


def started_at(base: str | None, start: Path | None, lpips: LpipsFiles) -> dict[str, Any]:
    """What is trained and where it starts, as parameters; the small painter unless said.

    `base` is a model for the one-step painter, with a preset after a colon; `start` holds weights
    of either painter to go on from.

    Raises:
        ConfigError: both a model and weights, or no such preset.
        WeightsError: the weights cannot be used.
    """
    if base is not None and start is not None:
        raise ConfigError("give --base or --start, not both: weights name their model themselves")
    model = base
    if start is not None and PainterChoice.of(start).kind == "one-step":
        model = str(start)
    if model is not None:
        return {"base": model, "lpips": lpips, "training": recipe_for(model)}
    if lpips != LpipsFiles():
        raise ConfigError("--lpips-backbone and --lpips-heads are for training with --base")
    return {} if start is None else {"start": start}


def shaped(
    training: PainterTraining,
    *,
    inputs: frozenset[str] | None = None,
    prompts: tuple[str, ...] | None = None,
    budget_s: float | None = None,
    steps: int | None = None,
) -> PainterTraining:
    """The recipe with other inputs and prompts where given, and as long as asked for.

    Raises:
        ConfigError: both lengths are given, one is not positive, a prompt is no style, or inputs
            are given for the one-step painter.
    """
    if budget_s is not None and steps is not None:
        raise ConfigError("give --budget or --steps, not both")
    steps = training.steps if steps is None else steps
    changes: dict[str, Any] = {"max_cpu_s": budget_s, "steps": steps}
    if isinstance(training, NanoTrainingConfig):
        old = training.network
        network = replace(old, inputs=inputs or old.inputs, prompts=prompts or old.prompts)
        return replace(training, network=network, **changes)
    if inputs is not None:
        raise ConfigError(
            "--inputs is for the small painter: the preset after --base wires the other, or "
            "--set training.network.inputs=render,lidar"
        )
    return replace(training, prompts=prompts or training.prompts, **changes)
