"""What a sequence will take, by what sequences have taken before.

Seconds, memory and bytes are sums of what grows with the effort: views read, pixels drawn, steps
and views at their width. The weights are found from the attempts in the catalog by non-negative
least squares on relative errors, so a short sequence counts as much as a long one. Where nothing is
known, nothing is said, and nothing is held back.
"""

import json
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from typing import Any, Self

import numpy as np
from jaxtyping import Float

from catalog.store import Store
from catalog.tables import Row
from flows.fleet.asked import Asked
from lidarpainter_models.painter.selection import NO_PAINTER

MOST_ATTEMPTS = 500
"""The newest ones, by which is planned."""
TARGETS = ("seconds", "peak_memory_bytes", "num_bytes")


@dataclass(frozen=True, slots=True, kw_only=True)
class Effort:
    """What the cost of a sequence grows with."""

    views: float
    """Trained on and judged."""
    view_pixels: float
    """Square of the width they are seen at."""
    steps: float
    """Of all fits."""
    painted_views: float
    read_views: float
    """To be read from a dataset first; none where the scene is in the store."""
    drawn_pixels: float
    """Likewise of a street, all views together."""

    def to_json(self) -> str:
        """As the catalog keeps it."""
        return json.dumps(asdict(self))

    @property
    def amounts(self) -> list[float]:
        """What costs are sums of."""
        return [
            1.0,
            self.steps * self.view_pixels,
            self.views * self.view_pixels,
            self.painted_views * self.view_pixels,
            self.read_views,
            self.drawn_pixels,
        ]


@dataclass(frozen=True, slots=True, kw_only=True)
class Prediction:
    """What a sequence is thought to take; None where nothing tells."""

    seconds: float | None = None
    memory_bytes: float | None = None
    num_bytes: float | None = None

    def facts(self) -> dict[str, Any]:
        """As a lease carries it to the catalog."""
        rounded = {name: None if value is None else round(value) for name, value in self._items()}
        return {**rounded, "predicted_seconds": self.seconds}

    def _items(self) -> Iterable[tuple[str, float | None]]:
        return [(f"predicted_{name}", getattr(self, name)) for name in self.__slots__]


class Planner:
    """Predicts from the attempts of one store."""

    def __init__(self, attempts: Sequence[Row], scenes: Sequence[Row]) -> None:
        """Learn.

        Args:
            attempts: rows of the table.
            scenes: likewise; whose views are known.
        """
        self._scenes = {row["scene_id"]: row for row in scenes}
        done = [row for row in attempts if row["cause"] == "done" and row["effort"]]
        self._past = sorted(done, key=lambda row: row["ended_at"])[-MOST_ATTEMPTS:]

    @classmethod
    def of(cls, store: Store) -> Self:
        """By what a store holds now."""
        return cls(store.tables.rows("attempts"), store.tables.rows("scenes"))

    def predict(self, asked: Asked) -> Prediction:
        """What a sequence will take."""
        effort = self.effort(asked)
        if effort is None or not self._past:
            return Prediction()
        amounts = np.asarray(effort.amounts)
        seconds, memory, num_bytes = (float(amounts @ weights) for weights in self._weights)
        return Prediction(seconds=seconds, memory_bytes=memory, num_bytes=num_bytes)

    def effort(self, asked: Asked) -> Effort | None:
        """What the cost of a sequence grows with; None where its views cannot be counted."""
        views = self._num_views(asked)
        if views is None:
            return None
        parameters, is_stored = asked.parameters, asked.scene_id in self._scenes
        paints = parameters.painter != NO_PAINTER
        drawn_pixels = read_views = 0.0
        if not is_stored and asked.seed is not None:
            street = asked.street
            drawn_pixels = street.num_frames * len(street.cameras) * float(street.width_px) ** 2
        elif not is_stored:
            read_views = views
        return Effort(
            views=views,
            view_pixels=float(parameters.observation.width_px) ** 2,
            steps=parameters.fit.steps + parameters.rounds * parameters.refine.steps,
            painted_views=views * parameters.rounds if paints else 0.0,
            read_views=read_views,
            drawn_pixels=drawn_pixels,
        )

    def _num_views(self, asked: Asked) -> float | None:
        row = self._scenes.get(asked.scene_id)
        if row is not None:
            share = len(asked.cameras) / len(row["cameras"]) if asked.cameras else 1.0
            return float(row["num_views"]) * share
        if asked.seed is not None:
            street = asked.street
            return float(street.num_frames * len(asked.cameras or street.cameras))
        if asked.frames is None or asked.cameras is None:
            return None
        return float((asked.frames[1] - asked.frames[0]) * len(asked.cameras))

    @cached_property
    def _weights(self) -> list[Float[np.ndarray, " amounts"]]:
        efforts = [Effort(**json.loads(row["effort"])).amounts for row in self._past]
        return [
            _fitted(
                np.asarray(efforts), np.asarray([row[name] or 0.0 for row in self._past], float)
            )
            for name in TARGETS
        ]


def _fitted(
    amounts: Float[np.ndarray, "attempts amounts"], costs: Float[np.ndarray, " attempts"]
) -> Float[np.ndarray, " amounts"]:
    """Non-negative weights whose sums come nearest to the costs, in relative terms."""
    from scipy.optimize import nnls

    is_known = costs > 0
    if not is_known.any():
        return np.zeros(amounts.shape[1])
    relative = amounts[is_known] / costs[is_known, None]
    scale = np.maximum(relative.max(axis=0), np.finfo(float).tiny)
    weights, _residual = nnls(relative / scale, np.ones(len(relative)))
    return weights / scale
