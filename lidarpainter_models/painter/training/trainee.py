"""What the training loop asks of a painter that it trains."""

from collections.abc import Mapping
from typing import Protocol, runtime_checkable

from torch import nn

from lidarpainter_models.painter.augmentation import TrainingBatch


@runtime_checkable
class Trainee(Protocol):
    """A network in training: some of its weights change, and it knows what to lower.

    The loop owns optimisers, schedule, averages and checkpoints; it never sees how the network is
    built.
    """

    @property
    def trained(self) -> Mapping[str, nn.Parameter]:
        """The weights that change, in float32, by names that stay the same between runs."""
        ...

    @property
    def opponent(self) -> nn.Module | None:
        """A discriminator with an optimiser of its own; trained beside, averaged never."""
        ...

    @property
    def num_warps(self) -> int:
        """Warped images that a sample has."""
        ...

    @property
    def prompts(self) -> tuple[str, ...]:
        """What the painter learns: the first restores, the others are styles."""
        ...

    def learn(self, batch: TrainingBatch, *, step: int, share: float) -> dict[str, float]:
        """Add the gradients of a batch to those of the trained weights and of the opponent.

        `share` is how much the batch counts among those of the step.

        Returns:
            What enters the history; `total` is the loss, and has to be finite.
        """
        ...

    def check(self, step: int, means: Mapping[str, float]) -> None:
        """Look at an entry of the history.

        Raises:
            TrainingError: the network has died.
        """
        ...
