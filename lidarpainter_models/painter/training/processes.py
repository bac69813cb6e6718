"""Several processes that train one network together, each on a device and on batches of its own.

After every step's backward passes the gradients are averaged over the processes, so that all take
the same step. Only the trained weights have gradients, some ten million numbers at most, so one
exchange a step does what a wrapper around the network would do, and leaves the network as it is.
"""

from collections.abc import Mapping, Sequence
from typing import Any, Protocol, runtime_checkable

import torch
from torch import Tensor


@runtime_checkable
class Processes(Protocol):
    """Who trains, and which of them this is."""

    @property
    def index(self) -> int:
        """Of this process; the first one writes checkpoints."""
        ...

    @property
    def count(self) -> int:
        """How many there are."""
        ...

    def average(self, tensors: Sequence[Tensor]) -> None:
        """Replace tensors, in place, by their means over the processes."""
        ...

    def mean(self, values: Mapping[str, float]) -> dict[str, float]:
        """Means of named numbers over the processes."""
        ...

    def meet(self) -> None:
        """Wait until every process is here."""
        ...


class OneProcess:
    """Trains alone: nothing is exchanged, and nothing is rounded on the way."""

    index = 0
    count = 1

    def average(self, tensors: Sequence[Tensor]) -> None:
        """Leave them."""

    def mean(self, values: Mapping[str, float]) -> dict[str, float]:
        """The numbers as they are."""
        return dict(values)

    def meet(self) -> None:
        """Go on."""


class AcceleratedProcesses:
    """The processes that `accelerate` has started, on whatever lies between them."""

    def __init__(self, accelerator: Any) -> None:  # noqa: ANN401 - accelerate's Accelerator
        """Take an `Accelerator`; of it, only its exchange of tensors is used."""
        self._accelerator = accelerator
        self.index = int(accelerator.process_index)
        self.count = int(accelerator.num_processes)

    def average(self, tensors: Sequence[Tensor]) -> None:
        """Replace tensors by their means, all in one exchange."""
        flat = torch.cat([tensor.flatten() for tensor in tensors])
        means = self._accelerator.reduce(flat, reduction="mean")
        parts = means.split([tensor.numel() for tensor in tensors])
        for tensor, part in zip(tensors, parts, strict=True):
            tensor.copy_(part.view(tensor.shape))

    def mean(self, values: Mapping[str, float]) -> dict[str, float]:
        """Means of named numbers, taken in float32."""
        found = torch.tensor(list(values.values()), device=self._accelerator.device)
        self.average([found])
        return dict(zip(values, found.tolist(), strict=True))

    def meet(self) -> None:
        """Wait until every process is here."""
        self._accelerator.wait_for_everyone()
