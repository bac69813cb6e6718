"""What checks of a scene say, and where along a log they look."""

from typing import Literal

import numpy as np

Verdict = Literal["ok", "warn", "fail"]


def sampled_positions(count: int, most: int = 4) -> list[int]:
    """A few positions spread evenly over `count`."""
    return sorted({round(x) for x in np.linspace(0, count - 1, min(count, most))})
