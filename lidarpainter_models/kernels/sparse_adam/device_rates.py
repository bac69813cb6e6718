"""The learning rates of the missed steps, kept on the moments' device from step to step.

The Triton backend leaves each step's rates there itself. The host sends them only where it has not:
after a checkpoint was taken up, or steps by another backend.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

KINDS = 6
"""Number of learning rates: one for each of the `Parameters`."""
LEAST_ROOM = 256
"""Steps that there is room for at first."""
NODE_NUMBERS = 4
"""Numbers that stand for a run of missed steps: weight and depth of its earlier node, then of its
later one."""


@dataclass(eq=False, kw_only=True)
class DeviceRates:
    """A copy of `AdamState.missed`, with the nodes that stand for the missed steps."""

    source: list[list[float]]
    """What is copied: a list that only grows."""
    rates: Float[Tensor, "room kinds"]
    filled: int = 0
    """Steps whose rates are there."""
    run_ends: Int[Tensor, " ends"]
    """Last step of each run, after a zero."""
    nodes: Float[Tensor, "room runs numbers kinds"]
    """Nodes for each number of steps that a row missed, from one on."""
    nodes_of: int = 0
    """Number of missed steps that the nodes were made for."""

    @classmethod
    def empty(
        cls, source: list[list[float]], run_ends: Sequence[int], device: torch.device
    ) -> "DeviceRates":
        """Room for twice the steps so far."""
        room = max(LEAST_ROOM, 2 * len(source))
        ends = torch.tensor([0, *run_ends], dtype=torch.int32)
        return cls(
            source=source,
            rates=torch.empty(room, KINDS, device=device),
            run_ends=ends.to(device, non_blocking=True),
            nodes=torch.empty(room, len(run_ends), NODE_NUMBERS, KINDS, device=device),
        )

    def follow(self, source: list[list[float]]) -> None:
        """Copy another list from now on."""
        if source is not self.source:
            self.source, self.filled, self.nodes_of = source, 0, 0

    def fill(self, steps: int) -> None:
        """Send the rates of the first steps, but for those that are there."""
        if self.filled < steps:
            late = torch.tensor(self.source[self.filled : steps])
            self.rates[self.filled : steps].copy_(late, non_blocking=True)
            self.filled = steps
