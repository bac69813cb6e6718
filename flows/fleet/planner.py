"""What a sequence will take, by what sequences have taken before.

CPU seconds and bytes are sums of what grows with the effort: views read, pixels drawn, steps and
views at their width; memory of a process and its views alone. The weights are found from the
attempts in the catalog by non-negative least squares on relative errors, so a short sequence counts
as much as a long one, and a recent one more than an old one. Where few attempts cannot tell the
amounts apart, each keeps a share of the cost, or of memory what is known of it. Compiling kernels
is paid once a machine and is taken out. Wall time is CPU time by the ratio that the machine had
lately: what else runs there is not the sequence's own. Where nothing is known, nothing is said, and
nothing is held back.
"""

import json
import platform
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from statistics import median
from typing import Any, Self

import numpy as np
from jaxtyping import Float

from catalog.store import Store
from catalog.tables import Row
from flows.fleet.asked import Asked
from lidarpainter_models.painter.known_painters import NO_PAINTER

MOST_ATTEMPTS = 500
"""The newest ones, by which is planned."""
HALF_LIFE = 10
"""Attempts after which one counts half as much."""
RECENT = 10
"""Attempts by which the ratio of wall to CPU time is known, and the error of the planner."""
SIZES = ("peak_memory_bytes", "num_bytes")
EQUAL_SHARES = 0.05
"""How much it counts, in attempts, that all amounts have a share of the cost."""
KNOWN_MEMORY = {"constant": 0.8e9, "views": 40.0}
"""Bytes of a process, and of each view for its width squared: what memory is made of, and about how
much. Attempts at one width cannot tell the two apart."""


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
    def amounts(self) -> dict[str, float]:
        """What costs are sums of."""
        return {
            "constant": 1.0,
            "steps": self.steps * self.view_pixels,
            "views": self.views * self.view_pixels,
            "painted_views": self.painted_views * self.view_pixels,
            "read_views": self.read_views,
            "drawn_pixels": self.drawn_pixels,
        }


@dataclass(frozen=True, slots=True, kw_only=True)
class Prediction:
    """What a sequence is thought to take; None where nothing tells."""

    seconds: float | None = None
    cpu_seconds: float | None = None
    """Without compiling kernels."""
    memory_bytes: float | None = None
    num_bytes: float | None = None

    def facts(self) -> dict[str, Any]:
        """As a lease carries it to the catalog."""
        sizes = {"memory_bytes": self.memory_bytes, "num_bytes": self.num_bytes}
        rounded = {name: None if size is None else round(size) for name, size in sizes.items()}
        facts = {"seconds": self.seconds, "cpu_seconds": self.cpu_seconds, **rounded}
        return {f"predicted_{name}": value for name, value in facts.items()}


class Planner:
    """Predicts from the attempts of one store."""

    def __init__(self, attempts: Sequence[Row], scenes: Sequence[Row]) -> None:
        """Learn from rows of the tables, of scenes whose views are known."""
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
        amounts = np.asarray(list(effort.amounts.values()))
        cpu_seconds, memory, num_bytes = (float(amounts @ weights) for weights in self._weights)
        return Prediction(
            seconds=cpu_seconds * self._wall_ratio,
            cpu_seconds=cpu_seconds,
            memory_bytes=memory,
            num_bytes=num_bytes,
        )

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
        width_px = parameters.observation.width_px
        if asked.seed is not None:
            width_px = min(width_px, asked.street.width_px)  # images are never enlarged
        return Effort(
            views=views,
            view_pixels=float(width_px) ** 2,
            steps=parameters.fit.most_steps(views)
            + parameters.rounds * parameters.refine.most_steps(views),
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
        """Of CPU seconds, memory and bytes."""
        past = [Effort(**json.loads(row["effort"])).amounts for row in self._past]
        efforts = np.asarray([list(amounts.values()) for amounts in past])
        known_memory = np.asarray([KNOWN_MEMORY.get(name, 0.0) for name in past[0]])
        costs = [[own_cpu_seconds(row) for row in self._past]]
        costs += [[row[name] or 0.0 for row in self._past] for name in SIZES]
        known = (None, known_memory, None)
        return [
            _fitted(efforts, np.asarray(cost, float), weights)
            for cost, weights in zip(costs, known, strict=True)
        ]

    @cached_property
    def _wall_ratio(self) -> float:
        """Of wall to CPU time in the newest attempts, those of this machine if there are any."""
        here = [row for row in self._past if row["worker"].rpartition(":")[0] == platform.node()]
        newest = (here or self._past)[-RECENT:]
        return median(row["seconds"] / max(row["cpu_seconds"] or 0.0, 1e-3) for row in newest)


def own_cpu_seconds(attempt: Mapping[str, Any]) -> float:
    """What a sequence took by itself: without compiling kernels for it and all after it."""
    return (attempt["cpu_seconds"] or 0.0) - (attempt["compile_seconds"] or 0.0)


def planner_error(attempts: Iterable[Mapping[str, Any]]) -> float | None:
    """How far off the predicted CPU seconds were, as a share of the true ones.

    It is the median of the newest attempts that were predicted; those that were recalled or went on
    with what others had begun do not count. None where there is none.
    """
    shares = [
        abs(row["predicted_cpu_seconds"] - own_cpu_seconds(row)) / own_cpu_seconds(row)
        for row in sorted(attempts, key=lambda row: row["ended_at"])
        if row["cause"] == "done" and row["effort"] and row["predicted_cpu_seconds"]
    ]
    return median(shares[-RECENT:]) if shares else None


def _fitted(
    amounts: Float[np.ndarray, "attempts amounts"],
    costs: Float[np.ndarray, " attempts"],
    known: Float[np.ndarray, " amounts"] | None,
) -> Float[np.ndarray, " amounts"]:
    """Non-negative weights whose sums come nearest to the costs, in relative terms.

    Attempts are oldest first; a cost that is not known is 0 or less. What attempts leave open comes
    near equal shares, or near weights that are known, as a share of each; amounts of no known
    weight have none.
    """
    from scipy.optimize import nnls

    is_known = costs > 0
    if not is_known.any():
        return np.zeros(amounts.shape[1])
    if known is not None:
        amounts = amounts * (known > 0)
    relative = amounts[is_known] / costs[is_known, None]
    scale = np.maximum(relative.mean(axis=0), np.finfo(float).tiny)
    ages = np.arange(len(relative))[::-1]
    counts = np.sqrt(0.5 ** (ages / HALF_LIFE))
    seen = (relative > 0).any(axis=0)
    expected = seen / seen.sum() if known is None else np.where(seen, known * scale, 1.0)
    pull = np.sqrt(EQUAL_SHARES) * seen / (1.0 if known is None else expected)
    weights, _residual = nnls(
        np.vstack([relative / scale * counts[:, None], np.diag(pull)]),
        np.concatenate([counts, pull * expected]),
    )
    return weights / scale
