"""The step sizes of everything that a fit changes, and Adam for its pose corrections.

Centres move in units of their Gaussian's own size: one learning rate then suits a pebble and a
far tower (`gaussian_adam`). Pose corrections step only when their view is drawn (a dense Adam would
let them drift on momentum for the dozen steps in between). Rates fall exponentially over the fit.
"""

import torch
from jaxtyping import Float
from torch import Tensor


class RowAdam:
    """Adam (Kingma and Ba, 2015) on a table whose rows have their own step sizes and counts.

    A row whose gradient is exactly zero is left alone: value, moments and count.
    """

    def __init__(self, table: Tensor, *, betas: tuple[float, float] = (0.9, 0.99)) -> None:
        """Start with empty moments; rows are the first dimension (or the first two, flattened)."""
        self.betas = betas
        self.first = torch.zeros_like(table)
        self.second = torch.zeros_like(table)
        self.count = torch.zeros(table.shape[0], dtype=torch.int64, device=table.device)

    def step(
        self,
        table: Tensor,
        gradient: Tensor,
        rate: Float[Tensor, "columns"],
        rows: slice | None = None,
    ) -> None:
        """One step in place on the rows with a gradient; `rate` is per column.

        Whoever knows these rows names them: to look for them, the host waits for the device.
        """
        if rows is not None:
            self._step(table, gradient, rate, rows)
        elif (found := gradient.abs().sum(dim=1).nonzero()[:, 0]).numel():
            self._step(table, gradient, rate, found)

    def _step(
        self, table: Tensor, gradient: Tensor, rate: Float[Tensor, "columns"], rows: slice | Tensor
    ) -> None:
        beta1, beta2 = self.betas
        g = gradient[rows]
        self.count[rows] += 1
        count = self.count[rows, None].to(g.dtype)
        first = beta1 * self.first[rows] + (1 - beta1) * g
        second = beta2 * self.second[rows] + (1 - beta2) * g * g
        self.first[rows], self.second[rows] = first, second
        spread = (second / (1 - beta2**count)).sqrt() + 1e-15
        with torch.no_grad():
            table[rows] -= rate * (first / (1 - beta1**count)) / spread

    def tensors(self) -> dict[str, Tensor]:
        """State to be kept in a checkpoint."""
        return {"first": self.first, "second": self.second, "count": self.count}

    def load(self, tensors: dict[str, Tensor]) -> None:
        """Take over kept state."""
        device = self.first.device
        self.first, self.second, self.count = (
            tensors[name].to(device, copy=True) for name in ("first", "second", "count")
        )
