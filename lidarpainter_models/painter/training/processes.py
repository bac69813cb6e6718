"""Several processes that train one network together, each on a device and on batches of its own.

After every step's backward passes the gradients are averaged over the processes, so that all take
the same step. Only the trained weights have gradients, some ten million numbers at most, so one
exchange a step does what a wrapper around the network would do, and leaves the network as it is.
"""

from collections.abc import Mapping, Sequence
from typing import Protocol, runtime_checkable

import torch
import torch.distributed
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

    def __init__(self, count: int = 1) -> None:
        """Take up what so many processes have trained."""
        self.count = count

    def average(self, tensors: Sequence[Tensor]) -> None:
        """Leave them."""

    def mean(self, values: Mapping[str, float]) -> dict[str, float]:
        """The numbers as they are."""
        return dict(values)

    def meet(self) -> None:
        """Go on."""


class DistributedProcesses:
    """The processes of torch's process group, which has been opened before."""

    def __init__(self, device: torch.device) -> None:
        """Take the device of this process, on which numbers are exchanged."""
        self._device = device
        self.index = torch.distributed.get_rank()
        self.count = torch.distributed.get_world_size()

    def average(self, tensors: Sequence[Tensor]) -> None:
        """Replace tensors by their means, all in one exchange."""
        flat = torch.cat([tensor.flatten() for tensor in tensors])
        torch.distributed.all_reduce(flat)
        parts = (flat / self.count).split([tensor.numel() for tensor in tensors])
        for tensor, part in zip(tensors, parts, strict=True):
            tensor.copy_(part.view(tensor.shape))

    def mean(self, values: Mapping[str, float]) -> dict[str, float]:
        """Means of named numbers, taken in float32."""
        found = torch.tensor(list(values.values()), device=self._device)
        self.average([found])
        return dict(zip(values, found.tolist(), strict=True))

    def meet(self) -> None:
        """Wait until every process is here."""
        torch.distributed.barrier()
