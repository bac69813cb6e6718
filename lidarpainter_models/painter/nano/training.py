"""Train the small painter on harvested pairs; a killed training resumes bit for bit.

A batch follows from the seed and the step alone (`augmentation.py`), and a checkpoint holds
weights, optimiser, averaged weights and history, so the weights after N steps do not depend on how
often the training was interrupted. The averaged weights (Polyak and Juditsky, 1992) are the result.
"""

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from lidarpainter_models.errors import ConfigError, DataError, TrainingError
from lidarpainter_models.painter.augmentation import AugmentationConfig, TrainingBatch, draw_batch
from lidarpainter_models.painter.examples import PairSource
from lidarpainter_models.painter.nano.losses import LossWeights, painting_loss
from lidarpainter_models.painter.nano.network import NanoConfig, NanoNetwork
from lidarpainter_models.painter.nano.training_checkpoints import (
    TrainingState,
    read_checkpoint,
    training_digest,
    write_checkpoint,
)
from lidarpainter_models.painter.protocol import DEFAULT_PROMPT
from lidarpainter_models.painter.styles import check_prompt

CPU = torch.device("cpu")
ALIVE_AFTER_STEPS = 1000
"""From here on a network that says the same in every pixel counts as dead."""
LEAST_SPREAD = 1e-3
"""Deviation of the expected log error over pixels under which it says the same everywhere."""


@dataclass(frozen=True, slots=True, kw_only=True)
class NanoTrainingConfig:
    """How the small painter is trained."""

    network: NanoConfig = field(default_factory=NanoConfig)
    augmentation: AugmentationConfig = field(default_factory=AugmentationConfig)
    loss: LossWeights = field(default_factory=LossWeights)
    steps: int = 20_000
    """Optimiser steps; the learning rate falls along a cosine to their end."""
    max_cpu_s: float | None = None
    """End after this many seconds of process CPU time instead, the schedule bent to fit; such a
    training cannot be repeated bit for bit."""
    batch_size: int = 6
    learning_rate: float = 2e-3
    warm_up_steps: int = 200
    weight_decay: float = 1e-4
    max_gradient_norm: float = 1.0
    """Longer gradients are scaled down to this."""
    average_decay: float = 0.999
    """Weights are averaged over about 1 / (1 - this) steps."""
    source_shares: tuple[float, ...] | None = None
    """Share of samples from each pair source; by default each pair is as likely as any other."""
    half_precision: bool = True
    """Convolutions in bfloat16: 1.7 times faster on a CPU with avx512_bf16."""
    seed: int = 0
    checkpoint_every_s: float = 120.0
    """Wall seconds between checkpoints; the end always writes one."""
    log_every_steps: int = 50
    """Steps that one entry of the history averages over."""

    def __post_init__(self) -> None:
        """Refuse schedules that cannot run."""
        for name in ("steps", "batch_size", "learning_rate", "log_every_steps"):
            if not getattr(self, name) > 0:
                raise ConfigError(f"{name} must be positive, got {getattr(self, name)}")
        if self.max_cpu_s is not None and self.max_cpu_s <= 0:
            raise ConfigError(f"max_cpu_s must be positive, got {self.max_cpu_s}")
        for prompt in self.network.prompts:
            check_prompt(prompt)
        if self.network.prompts[0] != DEFAULT_PROMPT:
            raise ConfigError(f"the first prompt must be {DEFAULT_PROMPT!r}, which restores")
        if not 0 <= self.average_decay < 1:
            raise ConfigError(f"average_decay must be in [0, 1), got {self.average_decay}")

    def to_dict(self) -> dict[str, Any]:
        """The settings as JSON types."""
        return asdict(self) | {"network": self.network.to_dict()}


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainingProgress:
    """Where a training stands, for a progress bar."""

    step: int
    share_done: float
    cpu_s: float
    losses: dict[str, float]
    """Means over the last interval of the history; empty before the first."""


@dataclass(frozen=True, kw_only=True, eq=False)
class TrainingResult:
    """A trained network and how it came to be."""

    network: NanoNetwork
    """With the averaged weights."""
    record: dict[str, Any]
    """Settings, pairs, steps, losses and duration as JSON types."""


def train_nano(
    sources: Sequence[PairSource],
    config: NanoTrainingConfig,
    *,
    start: NanoNetwork | None = None,
    checkpoint_folder: Path | None = None,
    progress: Callable[[TrainingProgress], None] | None = None,
    device: torch.device = CPU,
) -> TrainingResult:
    """Train the small painter, continuing from a checkpoint of the same training if there is one.

    Args:
        sources: sets of pairs; at least one pair in all.
        config: the whole recipe.
        start: weights to go on from; None starts from nothing.
        checkpoint_folder: where checkpoints are kept; None keeps none.
        progress: called at every entry of the history.
        device: where the network runs.

    Raises:
        DataError: no pairs, or a damaged pair.
        ConfigError: shares that do not fit the sources, first weights of another network, or a
            checkpoint of another training.
        TrainingError: the loss is no longer finite or the network has died; the last checkpoint
            stays as it was.
    """
    shares = _source_shares(sources, config)
    digest = training_digest(config.to_dict(), [source.digest for source in sources], start)
    state = TrainingState.start(config.network, config.seed, device, start)
    path = checkpoint_folder / "training.pt" if checkpoint_folder else None
    if path and path.exists():
        read_checkpoint(path, state, digest)
    clock = _Clock(state.cpu_s)
    while not _is_done(state, config):
        state.network.train()
        batch = _draw(sources, shares, state.step, config).to(device)
        losses = _step(state, batch, config)
        state.step += 1
        state.cpu_s = clock.cpu_s()
        _log(state, losses, config, progress)
        if path and clock.is_due(config.checkpoint_every_s):
            write_checkpoint(path, state, digest)
    if path:
        write_checkpoint(path, state, digest)
    return TrainingResult(
        network=state.averaged.eval(), record=_record(state, sources, config, digest)
    )


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


def _source_shares(sources: Sequence[PairSource], config: NanoTrainingConfig) -> list[float]:
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


def _share_done(state: TrainingState, config: NanoTrainingConfig) -> float:
    if config.max_cpu_s is not None:
        return state.cpu_s / config.max_cpu_s
    return state.step / config.steps


def _is_done(state: TrainingState, config: NanoTrainingConfig) -> bool:
    return _share_done(state, config) >= 1


def _draw(
    sources: Sequence[PairSource], shares: list[float], step: int, config: NanoTrainingConfig
) -> TrainingBatch:
    generator = torch.Generator().manual_seed((config.seed << 32) + step)
    return draw_batch(
        sources,
        shares,
        batch_size=config.batch_size,
        num_warps=config.network.num_sources,
        prompts=config.network.prompts,
        config=config.augmentation,
        generator=generator,
    )


def _learning_rate(state: TrainingState, config: NanoTrainingConfig) -> float:
    """A linear rise, then a cosine to zero."""
    rise = min(1.0, (state.step + 1) / max(config.warm_up_steps, 1))
    fall = 0.5 * (1 + math.cos(math.pi * min(_share_done(state, config), 1.0)))
    return config.learning_rate * rise * fall


def _step(
    state: TrainingState, batch: TrainingBatch, config: NanoTrainingConfig
) -> dict[str, float]:
    """One optimiser step; refuses to take one that is not finite.

    Returns the losses, and as `spread` the deviation over pixels of the expected log error.
    """
    for group in state.optimiser.param_groups:
        group["lr"] = _learning_rate(state, config)
        group["weight_decay"] = config.weight_decay
    output = state.network(batch.conditions, batch.prompts, half_precision=config.half_precision)
    terms = painting_loss(
        output,
        batch.conditions,
        batch.target,
        batch.target_valid,
        config.loss,
        restyled=batch.restyled,
    )
    state.optimiser.zero_grad(set_to_none=True)
    terms.total.backward()
    norm = torch.nn.utils.clip_grad_norm_(state.network.parameters(), config.max_gradient_norm)
    if not bool(torch.isfinite(terms.total) & torch.isfinite(norm)):
        raise TrainingError(
            f"loss {float(terms.total.detach())} with gradient norm {float(norm)} at step "
            f"{state.step}: the training stops, its last checkpoint is kept; try a lower "
            "learning_rate"
        )
    state.optimiser.step()
    _average(state, config.average_decay)
    return terms.to_dict() | {"spread": float(output.log_error.detach().std())}


@torch.no_grad()
def _average(state: TrainingState, decay: float) -> None:
    """Move the averaged weights; at first they follow closely."""
    follow = 1 - min(decay, (1 + state.step) / (10 + state.step))
    averaged: list[Tensor] = list(state.averaged.parameters())
    torch._foreach_lerp_(averaged, list(state.network.parameters()), follow)


def _log(
    state: TrainingState,
    losses: dict[str, float],
    config: NanoTrainingConfig,
    progress: Callable[[TrainingProgress], None] | None,
) -> None:
    for name, value in losses.items():
        state.running[name] = state.running.get(name, 0.0) + value
    if state.step % config.log_every_steps:
        return
    means = {name: value / config.log_every_steps for name, value in state.running.items()}
    state.running.clear()
    state.history.append({"step": state.step, "cpu_s": round(state.cpu_s, 1), **means})
    if state.step > ALIVE_AFTER_STEPS and means["spread"] < LEAST_SPREAD:
        raise TrainingError(
            f"the network says the same in every pixel at step {state.step}: the training stops, "
            "its last checkpoint is kept; start again with a lower learning_rate"
        )
    if progress:
        done = min(_share_done(state, config), 1.0)
        progress(
            TrainingProgress(step=state.step, share_done=done, cpu_s=state.cpu_s, losses=means)
        )


def _record(
    state: TrainingState, sources: Sequence[PairSource], config: NanoTrainingConfig, digest: str
) -> dict[str, Any]:
    return {
        "config": config.to_dict(),
        "training_digest": digest,
        "num_pairs": sum(len(source) for source in sources),
        "pairs": [source.describe() for source in sources],
        "seed": config.seed,
        "steps": state.step,
        "cpu_s": round(state.cpu_s, 1),
        "torch": torch.__version__,
        "history": state.history,
    }
