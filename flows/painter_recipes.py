"""What the options of a training make of its recipe."""

from dataclasses import replace
from pathlib import Path
from typing import Any

from lidarpainter_models.errors import ConfigError
from lidarpainter_models.metrics.lpips_files import LpipsFiles
from lidarpainter_models.painter.nano.training import NanoTrainingConfig
from lidarpainter_models.painter.selection import PainterChoice
from lidarpainter_models.painter.training_jobs import PainterTraining, recipe_for


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
