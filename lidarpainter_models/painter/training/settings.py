"""Settings that every training of a painter has; each painter adds its own and its defaults."""

import math
from dataclasses import asdict, dataclass, field
from typing import Any

from lidarpainter_models.errors import ConfigError
from lidarpainter_models.painter.augmentation import AugmentationConfig
from lidarpainter_models.painter.protocol import DEFAULT_PROMPT
from lidarpainter_models.painter.styles import check_prompt


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainingConfig:
    """How long, how fast and on what a painter is trained."""

    augmentation: AugmentationConfig = field(default_factory=AugmentationConfig)
    steps: int
    """Optimiser steps; the learning rate falls along a cosine to their end."""
    max_cpu_s: float | None = None
    """End after this many seconds of process CPU time instead, the schedule bent to fit; such a
    training cannot be repeated bit for bit."""
    batch_size: int
    """Samples that pass through the network at once, in each process."""
    accumulated_batches: int = 1
    """Batches whose gradients one step averages, in each process."""
    learning_rate: float
    warm_up_steps: int
    weight_decay: float
    max_gradient_norm: float = 1.0
    """Longer gradients are scaled down to this."""
    average_decay: float = 0.999
    """Weights are averaged over about 1 / (1 - this) steps."""
    source_shares: tuple[float, ...] | None = None
    """Share of samples from each pair source; by default each pair is as likely as any other."""
    half_precision: bool = True
    """Compute in bfloat16; the weights that are trained stay in float32."""
    seed: int = 0
    checkpoint_every_s: float = 120.0
    """Wall seconds between checkpoints; the end always writes one."""
    log_every_steps: int = 50
    """Steps that one entry of the history averages over."""

    def __post_init__(self) -> None:
        positive = ("steps", "batch_size", "accumulated_batches", "log_every_steps")
        for name in (*positive, "max_gradient_norm"):
            if not getattr(self, name) > 0:
                raise ConfigError(f"{name} must be positive, got {getattr(self, name)}")
        if not 0 < self.learning_rate <= 1:
            raise ConfigError(f"learning_rate must be in (0, 1], got {self.learning_rate}")
        if not 0 <= self.weight_decay <= 1:
            raise ConfigError(f"weight_decay must be in [0, 1], got {self.weight_decay}")
        if self.max_cpu_s is not None and self.max_cpu_s <= 0:
            raise ConfigError(f"max_cpu_s must be positive, got {self.max_cpu_s}")
        if not 0 <= self.average_decay < 1:
            raise ConfigError(f"average_decay must be in [0, 1), got {self.average_decay}")

    def share_done(self, step: int, cpu_s: float) -> float:
        """How much of the training is done after some steps and seconds; 1 and more at its end."""
        return step / self.steps if self.max_cpu_s is None else cpu_s / self.max_cpu_s

    def learning_rate_at(self, step: int, share_done: float) -> float:
        """A linear rise, then a cosine to zero."""
        rise = min(1.0, (step + 1) / max(self.warm_up_steps, 1))
        fall = 0.5 * (1 + math.cos(math.pi * min(share_done, 1.0)))
        return self.learning_rate * rise * fall

    def to_dict(self) -> dict[str, Any]:
        """The settings as JSON types."""
        return asdict(self)


def check_prompts(prompts: tuple[str, ...]) -> None:
    """Refuse prompts that no training can have pairs for.

    Raises:
        ConfigError: one is no style, stands twice, or the first does not restore.
    """
    for prompt in prompts:
        check_prompt(prompt)
    if not prompts or prompts[0] != DEFAULT_PROMPT:
        raise ConfigError(f"the first prompt must be {DEFAULT_PROMPT!r}, which restores")
