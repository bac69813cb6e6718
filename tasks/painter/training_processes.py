"""Train the one-step painter in several processes, one per GPU, from a single command.

This process is the first of them and starts the others; `accelerate` finds them by the variables
that its own launcher would set. On a machine without GPUs they exchange gradients through gloo.
"""

import multiprocessing
import os
import socket
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing.context import SpawnProcess
from pathlib import Path
from typing import Any

import torch

from lidarpainter_models.errors import ConfigError, LidarPainterError, TrainingError
from lidarpainter_models.metrics.lpips import LpipsFiles, load_lpips
from lidarpainter_models.painter.adversarial import FrozenFeatures
from lidarpainter_models.painter.examples import PairSource
from lidarpainter_models.painter.one_step.loading import Trainable, load_trainable
from lidarpainter_models.painter.one_step.packages import diffusion_package
from lidarpainter_models.painter.one_step.training import (
    Judges,
    OneStepTrainee,
    OneStepTrainingConfig,
    train_one_step,
)
from lidarpainter_models.painter.training.loop import ALONE, TrainingProgress
from lidarpainter_models.painter.training.processes import AcceleratedProcesses, Processes

HOST = "127.0.0.1"
GRACE_S = 60.0
"""How long the others may take to end once the first has."""

Told = Callable[[TrainingProgress], None]


@dataclass(frozen=True, kw_only=True)
class Lesson:
    """What every process has to know."""

    start: str
    """A model, or weights to go on from."""
    config: OneStepTrainingConfig
    lpips: LpipsFiles
    sources: Sequence[PairSource]
    checkpoints: Path


def train_together(
    lesson: Lesson, num_processes: int, told: Told
) -> tuple[Trainable, dict[str, Any]]:
    """Train in this process and as many others as asked for.

    Returns the network, trained, and the record.

    Raises:
        ConfigError: fewer GPUs than processes, on a machine that has some.
        TrainingError: the loss is no longer finite, or another process has ended early.
    """
    if num_processes == 1:
        device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
        return _train(lesson, device, ALONE, told)
    if 0 < torch.cuda.device_count() < num_processes:
        raise ConfigError(
            f"{num_processes} processes need as many GPUs, this machine has "
            f"{torch.cuda.device_count()}"
        )
    port = _free_port()
    context = multiprocessing.get_context("spawn")
    others = [
        context.Process(target=_join, args=(lesson, index, num_processes, port), daemon=True)
        for index in range(1, num_processes)
    ]
    for other in others:
        other.start()
    try:
        with _accelerated(0, num_processes, port) as (device, processes):
            return _train(lesson, device, processes, told)
    except TrainingError:
        raise
    except RuntimeError as error:
        raise TrainingError(
            "a training in several processes broke off, its last checkpoint is kept: "
            f"{_first_line(error)}"
        ) from None
    finally:
        _end(others)


def _join(lesson: Lesson, index: int, num_processes: int, port: int) -> None:
    """Train as one of the others; what ends this one alone is a line on its way out."""
    try:
        with _accelerated(index, num_processes, port) as (device, processes):
            _train(lesson, device, processes, None)
    except TrainingError:
        return  # the loss is everyone's: the first process says it
    except (LidarPainterError, RuntimeError) as error:
        raise SystemExit(f"process {index} of the training: {_first_line(error)}") from None


def _train(
    lesson: Lesson, device: torch.device, processes: Processes, told: Told | None
) -> tuple[Trainable, dict[str, Any]]:
    config = lesson.config
    made = load_trainable(
        lesson.start,
        config.network,
        prompts=config.prompts,
        dtype=torch.bfloat16 if config.half_precision else torch.float32,
        seed=config.seed,
    )
    judges = judges_of(lesson.lpips, device)
    trainee = OneStepTrainee(made.network.to(device), made.texts, config, judges)
    record = train_one_step(
        trainee,
        lesson.sources,
        checkpoint_folder=lesson.checkpoints,
        progress=told,
        processes=processes,
    )
    return made, record


def judges_of(files: LpipsFiles, device: torch.device) -> Judges:
    """LPIPS, and its backbone for the discriminator to look through, where there are weights.

    Raises:
        WeightsError: the files cannot be used.
    """
    lpips = load_lpips(files)
    if lpips is None:
        return Judges()
    lpips = lpips.to(device)
    features = FrozenFeatures(extract=lpips.features, channels=lpips.channels)
    return Judges(lpips=lpips.of_batch, features=features)


@contextmanager
def _accelerated(
    index: int, num_processes: int, port: int
) -> Iterator[tuple[torch.device, Processes]]:
    """Meet the other processes; leaves the environment as it was."""
    before = dict(os.environ)
    os.environ |= {
        "RANK": str(index),
        "LOCAL_RANK": str(index),
        "WORLD_SIZE": str(num_processes),
        "MASTER_ADDR": HOST,
        "MASTER_PORT": str(port),
    }
    accelerate = diffusion_package("accelerate")
    try:
        accelerator = accelerate.Accelerator(cpu=not torch.cuda.is_available())
        yield accelerator.device, AcceleratedProcesses(accelerator)
    finally:
        # accelerate remembers its processes for the life of this one, and they end here
        accelerate.state.AcceleratorState._reset_state(reset_partial_state=True)
        if torch.distributed.is_initialized():
            torch.distributed.destroy_process_group()
        os.environ.clear()
        os.environ.update(before)


def _first_line(error: Exception) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0]


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind((HOST, 0))
        return int(probe.getsockname()[1])


def _end(others: Sequence[SpawnProcess]) -> None:
    """Let the others end by themselves, or end them."""
    for other in others:
        other.join(GRACE_S)
        if other.is_alive():
            other.kill()
            other.join()
