"""Train a painter on harvested pairs; a killed training resumes bit for bit.

A batch follows from the seed and its number alone (`augmentation.py`), and a checkpoint holds
weights, optimisers, averaged weights and history, so the weights after N steps do not depend on how
often the training was interrupted. The averaged weights (Polyak and Juditsky, 1992) are the result.

Several processes take the batches of a step in turn: two processes with one batch each take the
step that one process takes with two accumulated batches, up to the order of a sum.
"""

import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import torch
from torch import Tensor, nn

from lidarpainter_models.errors import ConfigError, DataError, TrainingError
from lidarpainter_models.painter.augmentation import TrainingBatch, draw_batch
from lidarpainter_models.painter.examples import PairSource
from lidarpainter_models.painter.training.batch_stream import batches_in_order
from lidarpainter_models.painter.training.checkpoints import (
    CHECKPOINT_NAME,
    TrainingState,
    read_checkpoint,
    write_checkpoint,
)
from lidarpainter_models.painter.training.processes import Processes
from lidarpainter_models.painter.training.settings import TrainingConfig

ALONE = Processes()


@runtime_checkable
class Trainee(Protocol):
    """A network in training: some of its weights change, and it knows what to lower.

    The loop owns optimisers, schedule, averages and checkpoints; it never sees how the network is
    built.
    """

    trained: Mapping[str, nn.Parameter]
    """The weights that change, in float32, by names that stay the same between runs."""
    opponent: nn.Module | None
    """A discriminator with an optimiser of its own; trained beside, averaged never."""
    num_warps: int
    """Warped images that a sample has."""
    prompts: tuple[str, ...]
    """What the painter learns: the first restores, the others are styles."""

    def learn(self, batch: TrainingBatch, *, step: int, share: float) -> dict[str, float]:
        """Add the gradients of a batch to those of the trained weights and of the opponent.

        `share` is how much the batch counts among those of the step. Returns what enters the
        history; `total` is the loss, and has to be finite.
        """

    def check(self, step: int, means: Mapping[str, float]) -> None:
        """Look at an entry of the history.

        Raises:
            TrainingError: the network has died.
        """


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainingProgress:
    """Where a training stands, for a progress bar."""

    step: int
    share_done: float
    cpu_s: float
    losses: dict[str, float]
    """Means over the last interval of the history; empty before the first."""


Told = Callable[[TrainingProgress], None]


def run_training(
    trainee: Trainee,
    sources: Sequence[PairSource],
    config: TrainingConfig,
    *,
    digest: str,
    checkpoint_folder: Path | None = None,
    progress: Told | None = None,
    processes: Processes = ALONE,
) -> dict[str, Any]:
    """Train in place, continuing from a checkpoint of the same training if there is one.

    Afterwards the network holds the averaged weights. A checkpoint of another `digest`, that of
    everything that shapes the weights, is refused. `progress` is called at every entry of the
    history.

    Returns:
        How the network came to be: settings, pairs, steps, losses and duration as JSON types.

    Raises:
        DataError: no pairs, or a damaged pair.
        ConfigError: shares that do not fit the sources, or a checkpoint of another training.
        TrainingError: the loss is no longer finite or the network has died; the last checkpoint
            stays as it was.
    """
    shares = source_shares(sources, config)
    state = TrainingState.start(trainee.trained, trainee.opponent)
    path = checkpoint_folder / CHECKPOINT_NAME if checkpoint_folder else None
    if path and path.exists():
        read_checkpoint(path, state, digest)
    processes.meet()  # all have read before the first one writes
    writes = path if processes.index == 0 else None
    batches = batches_in_order(
        partial(_draw, sources, shares, trainee.num_warps, trainee.prompts, config),
        state.device,
        first=state.step * config.accumulated_batches * processes.count + processes.index,
        every=processes.count,
    )
    clock = _Clock(state.cpu_s)
    while config.share_done(state.step, state.cpu_s) < 1:
        losses = _step(trainee, state, batches, config, processes)
        state.step += 1
        state.cpu_s = clock.cpu_s()
        _log(trainee, state, losses, config, progress)
        if writes and clock.is_due(config.checkpoint_every_s):
            write_checkpoint(writes, state, digest)
    if writes:
        write_checkpoint(writes, state, digest)
    state.take_averages()
    return _record(state, sources, config, digest, processes)


class _Clock:
    """Process CPU time, summed over interruptions, and the time since the last checkpoint."""

    def __init__(self, cpu_s_before: float) -> None:
        self._offset_s = cpu_s_before - time.process_time()
        self._saved_s = time.monotonic()

    def cpu_s(self) -> float:
        return self._offset_s + time.process_time()

    def is_due(self, interval_s: float) -> bool:
        now_s = time.monotonic()
        if now_s - self._saved_s < interval_s:
            return False
        self._saved_s = now_s
        return True


def source_shares(sources: Sequence[PairSource], config: TrainingConfig) -> list[float]:
    """How likely each source is.

    Raises:
        DataError: there are no pairs.
        ConfigError: the shares do not fit the sources.
    """
    sizes = [len(source) for source in sources]
    if sum(sizes) == 0:
        raise DataError("no training pairs: harvest some first")
    if config.source_shares is None:
        return [float(size) for size in sizes]
    shares = list(config.source_shares)
    empty = [share > 0 and size == 0 for share, size in zip(shares, sizes, strict=False)]
    if len(shares) != len(sizes) or min(shares) < 0 or sum(shares) == 0 or any(empty):
        raise ConfigError(
            f"source_shares {shares} do not fit {len(sizes)} pair sources of {sizes} pairs"
        )
    return shares


def _draw(
    sources: Sequence[PairSource],
    shares: list[float],
    num_warps: int,
    prompts: Sequence[str],
    config: TrainingConfig,
    number: int,
) -> TrainingBatch:
    generator = torch.Generator().manual_seed((config.seed << 32) + number)
    return draw_batch(
        sources,
        shares,
        batch_size=config.batch_size,
        num_warps=num_warps,
        prompts=prompts,
        config=config.augmentation,
        generator=generator,
    )


def _step(
    trainee: Trainee,
    state: TrainingState,
    batches: Iterator[TrainingBatch],
    config: TrainingConfig,
    processes: Processes,
) -> dict[str, float]:
    """One optimiser step; refuses to take one that is not finite. Returns the mean losses."""
    optimisers = list(state.optimisers.values())
    for optimiser in optimisers:
        optimiser.zero_grad(set_to_none=True)
    parts = config.accumulated_batches
    losses: dict[str, float] = {}
    for batch in islice(batches, parts):
        found = trainee.learn(batch, step=state.step, share=1 / parts)
        for name, value in found.items():
            losses[name] = losses.get(name, 0.0) + value / parts
    losses = processes.mean(losses)
    share_done = config.share_done(state.step, state.cpu_s)
    norms = [_clipped_norm(optimiser, config, processes) for optimiser in optimisers]
    if not math.isfinite(losses["total"]) or not all(map(math.isfinite, norms)):
        raise TrainingError(
            f"loss {losses['total']} with gradient norms {norms} at step "
            f"{state.step}: the training stops, its last checkpoint is kept; try a lower "
            "learning_rate"
        )
    rate = config.learning_rate_at(state.step, share_done)
    for optimiser in optimisers:
        for group in optimiser.param_groups:
            group["lr"], group["weight_decay"] = rate, config.weight_decay
        optimiser.step()
    _average(state, config.average_decay)
    return losses


def _clipped_norm(
    optimiser: torch.optim.Optimizer, config: TrainingConfig, processes: Processes
) -> float:
    """Average the gradients over the processes and shorten them; returns their length before."""
    parameters = [one for group in optimiser.param_groups for one in group["params"]]
    processes.average([one.grad for one in parameters if one.grad is not None])
    return float(torch.nn.utils.clip_grad_norm_(parameters, config.max_gradient_norm))


@torch.no_grad()
def _average(state: TrainingState, decay: float) -> None:
    """Move the averaged weights; at first they follow closely."""
    follow = 1 - min(decay, (1 + state.step) / (10 + state.step))
    averaged: list[Tensor] = list(state.averaged.values())
    torch._foreach_lerp_(averaged, list(state.trained.values()), follow)


def _log(
    trainee: Trainee,
    state: TrainingState,
    losses: dict[str, float],
    config: TrainingConfig,
    progress: Told | None,
) -> None:
    for name, value in losses.items():
        state.running[name] = state.running.get(name, 0.0) + value
    if state.step % config.log_every_steps:
        return
    means = {name: value / config.log_every_steps for name, value in state.running.items()}
    state.running.clear()
    state.history.append({"step": state.step, "cpu_s": round(state.cpu_s, 1), **means})
    trainee.check(state.step, means)
    if progress:
        done = min(config.share_done(state.step, state.cpu_s), 1.0)
        progress(
            TrainingProgress(step=state.step, share_done=done, cpu_s=state.cpu_s, losses=means)
        )


def _record(
    state: TrainingState,
    sources: Sequence[PairSource],
    config: TrainingConfig,
    digest: str,
    processes: Processes,
) -> dict[str, Any]:
    return {
        "config": config.to_dict(),
        "training_digest": digest,
        "num_pairs": sum(len(source) for source in sources),
        "pairs": [source.describe() for source in sources],
        "seed": config.seed,
        "steps": state.step,
        "cpu_s": round(state.cpu_s, 1),
        "processes": processes.count,
        "torch": torch.__version__,
        "device": state.device.type,
        "history": state.history,
    }
