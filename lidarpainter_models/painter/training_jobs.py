"""Which training job a recipe and a start make, and which recipe a start asks for."""

from pathlib import Path

import torch

from lidarpainter_models.errors import ConfigError
from lidarpainter_models.metrics.lpips_files import LpipsFiles
from lidarpainter_models.painter.known_painters import WEIGHTS_SUFFIX, split_preset
from lidarpainter_models.painter.nano.painter import NanoPainter
from lidarpainter_models.painter.nano.training import NanoJob, NanoTrainingConfig
from lidarpainter_models.painter.one_step.config import PRESETS
from lidarpainter_models.painter.one_step.job import CPU, NO_FILES, OneStepJob
from lidarpainter_models.painter.one_step.training import OneStepTrainingConfig
from lidarpainter_models.painter.one_step.weights import read_trained
from lidarpainter_models.painter.selection import PainterChoice
from lidarpainter_models.painter.training.job import TrainingJob

PainterTraining = NanoTrainingConfig | OneStepTrainingConfig


def job_for(
    config: PainterTraining,
    start: str | Path | None,
    lpips: LpipsFiles = NO_FILES,
    *,
    device: torch.device = CPU,
    num_processes: int = 1,
) -> TrainingJob:
    """The job of a recipe; what it needs is checked, and not yet read whole.

    The start is weights to go on from, or for the one-step painter its model. The device is that of
    a training in one process.

    Raises:
        ConfigError: the one-step painter has no model, its loss lacks what it weighs, several
            processes that cannot train together, or a start that learns nothing.
        WeightsError: the model or the first weights cannot be used.
    """
    if num_processes < 1 or (num_processes > 1 and config.max_cpu_s is not None):
        raise ConfigError(f"{num_processes} processes cannot share a budget: give --steps")
    if isinstance(config, NanoTrainingConfig):
        if num_processes > 1:
            raise ConfigError("the small painter is trained in one process")
        return NanoJob(config, None if start is None else _first_nano(Path(start)), device)
    if start is None:
        raise ConfigError("the one-step painter is trained on a model: give --base")
    return OneStepJob(str(start), config, lpips, device=device, num_processes=num_processes)


def recipe_for(start: str) -> OneStepTrainingConfig:
    """The recipe for a model with a preset after a colon, or for a weights file to go on from.

    Raises:
        WeightsError: it is not there.
    """
    if start.endswith(WEIGHTS_SUFFIX):
        return OneStepTrainingConfig(network=read_trained(Path(start)).config)
    return OneStepTrainingConfig(network=PRESETS[split_preset(start)[1]])


def _first_nano(start: Path) -> NanoPainter:
    choice = PainterChoice.of(start)
    painter = choice.load(CPU) if choice.kind == "nano" else None
    if not isinstance(painter, NanoPainter):
        raise ConfigError(f"{start}: expected a trained painter that says what it has learnt")
    return painter
