"""How many Gaussians a fit may have, and when; read without tensors.

The most follow from what the views show (`plan`) or are set, and a memory limit lowers them. A fit
starts with a part of them (`initialisation`) and grows the rest where images are wrong, in even
rounds (`densification`).
"""

import math
from dataclasses import dataclass

from lidarpainter_models.errors import ConfigError

START_SHARE = 0.6875
"""Part of the most Gaussians that a fit starts with; the rest is grown where images are wrong (a
real log lost 0.3 dB without)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DensificationConfig:
    """When and how far the number of Gaussians changes."""

    budget: int = 0
    """The most Gaussians of a fit; 0 follows the effort of the fit."""
    start: float = 0.1
    """Fraction of the fit after which splitting begins: gradients must mean something."""
    stop: float = 0.6
    """Fraction of the fit after which splitting ends: new Gaussians need time to settle."""
    every: int = 50
    """Steps between two splittings; several passes over the views of a short log."""

    def __post_init__(self) -> None:
        """Refuse a schedule that runs backwards."""
        if not 0 <= self.start <= self.stop <= 1 or self.every < 1:
            raise ConfigError(
                f"densification needs 0 <= start <= stop <= 1 and every >= 1, got start "
                f"{self.start}, stop {self.stop}, every {self.every}"
            )
        if self.budget < 0:
            raise ConfigError(f"densification.budget must not be negative, got {self.budget}")

    def allowed_now(self, num_gaussians: int, fraction: float, steps: int) -> int:
        """Return how many Gaussians there may be after a splitting: even steps up to the budget.

        Args:
            num_gaussians: there are now.
            fraction: part of the fit that is done, 0 to 1.
            steps: of the fit in all.
        """
        first = min(num_gaussians, self.budget)
        progress = (fraction - self.start) / max(self.stop - self.start, 1e-9)
        rounds_left = max((1 - progress) * (self.stop - self.start), 0) * steps
        rounds_left = 1 + rounds_left // self.every
        return first + math.ceil((self.budget - first) / rounds_left)
