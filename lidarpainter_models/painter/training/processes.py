"""Several processes that train one network together, each on a device and on batches of its own.

After every step's backward passes the gradients are averaged over the processes, so that all take
the same step. Only the trained weights have gradients, some ten million numbers at most, so one
exchange a step does what a wrapper around the network would do, and leaves the network as it is.
"""

from collections.abc import Mapping, Sequence

import torch
import torch.distributed
from torch import Tensor


class Processes:
    """Who trains, and which of them this is; alone nothing is exchanged or rounded on the way."""

    def __init__(self, count: int = 1, device: torch.device | None = None) -> None:
        """Train alone, or go on alone with what `count` processes have trained.

        With a device this is one of torch's process group, which has been opened before; numbers
        are exchanged on that device.
        """
        self._device = device
        self.count = count if device is None else torch.distributed.get_world_size()
        self.index = 0 if device is None else torch.distributed.get_rank()
        """The first one writes checkpoints."""

    def average(self, tensors: Sequence[Tensor]) -> None:
        """Replace tensors, in place, by their means over the processes, all in one exchange."""
        if self._device is None:
            return
        flat = torch.cat([tensor.flatten() for tensor in tensors])
        torch.distributed.all_reduce(flat)
        parts = (flat / self.count).split([tensor.numel() for tensor in tensors])
        for tensor, part in zip(tensors, parts, strict=True):
            tensor.copy_(part.view(tensor.shape))

    def mean(self, values: Mapping[str, float]) -> dict[str, float]:
        """Means of named numbers over the processes, taken in float32."""
        if self._device is None:
            return dict(values)
        found = torch.tensor(list(values.values()), device=self._device)
        self.average([found])
        return dict(zip(values, found.tolist(), strict=True))

    def meet(self) -> None:
        """Wait until every process is here."""
        if self._device is not None:
            torch.distributed.barrier()
