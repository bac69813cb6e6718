"""Which way is worth its cost: means over seeds with their bars, the front of Pareto, its knee."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

CONFIDENCE = 0.95
LEAST_BEND = 1e-6
"""Of the height of a front; less is a straight line."""


@dataclass(frozen=True, slots=True)
class Spread:
    """A figure over repeated trials."""

    mean: float
    half_width: float
    """Of its 95 % interval (Student's t); infinite for a single trial."""

    @classmethod
    def of(cls, values: Sequence[float]) -> "Spread":
        """Of at least one trial."""
        from scipy.stats import t

        if len(values) < 2:
            return cls(float(values[0]), math.inf)
        error = float(np.std(values, ddof=1)) / math.sqrt(len(values))
        reach = float(t.ppf((1 + CONFIDENCE) / 2, len(values) - 1))
        return cls(float(np.mean(values)), reach * error)

    @property
    def is_sure(self) -> bool:
        """Whether the interval leaves zero out."""
        return abs(self.mean) > self.half_width


def paired_gain(ours: Sequence[float], theirs: Sequence[float]) -> Spread:
    """How much more one way gives than another, over pairs of equal scene and seed (paired t)."""
    return Spread.of(np.subtract(ours, theirs).tolist())


def pareto_front(costs: Sequence[float], qualities: Sequence[float]) -> list[int]:
    """The points that nothing beats at their cost or less, from the cheapest on."""
    best, front = -math.inf, []
    for index in sorted(range(len(costs)), key=lambda one: (costs[one], -qualities[one])):
        if qualities[index] > best:
            best = qualities[index]
            front.append(index)
    return front


def knee(costs: Sequence[float], qualities: Sequence[float]) -> int:
    """The point of a front that lies farthest above the line between its ends.

    Cost counts by its logarithm: twice as much is one step, whatever it was (Satopaa et al.,
    "Finding a 'Kneedle' in a Haystack", 2011). Costs are positive; both ascend.
    """
    across, up = np.log(np.asarray(costs, float)), np.asarray(qualities, float)
    spans = across[-1] - across[0], up[-1] - up[0]
    if min(spans) <= 0:
        return 0
    above = (up - up[0]) / spans[1] - (across - across[0]) / spans[0]
    return int(above.argmax()) if above.max() > LEAST_BEND else 0


def beats(cost: Spread, quality: Spread, other_cost: Spread, other_quality: Spread) -> bool:
    """Whether one way is both cheaper and better than another by more than the bars of both."""
    cheaper = other_cost.mean - cost.mean > math.hypot(cost.half_width, other_cost.half_width)
    apart = math.hypot(quality.half_width, other_quality.half_width)
    return cheaper and quality.mean - other_quality.mean > apart
