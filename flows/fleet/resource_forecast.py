"""What a sequence will take, by what sequences have taken before.

What it takes on the reference machine follows from its size (`flows.time_prediction`); attempts in
the catalog tell by which factor this store's machines differ, a recent one more than an old one.
Compiling kernels is paid once a machine and is taken out. Wall time is CPU time by the ratio that
the machine had lately: what else runs there is not the sequence's own. Where nothing is known,
nothing is said, and nothing is held back.
"""

import json
import math
import platform
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from functools import cached_property
from statistics import median
from typing import Any, Self

from catalog.store import Store
from catalog.tables import Row
from flows.fleet.asked_sequences import Asked
from flows.time_prediction import reference_seconds

MOST_ATTEMPTS = 500
"""The newest attempts, by which is planned."""
HALF_LIFE = 10
"""Attempts after which one counts half as much."""
RECENT = 10
"""Attempts by which the ratio of wall to CPU time is known, and the error of the forecast."""
READ_VIEW_S, DRAWN_PIXEL_S = 0.25, 2e-6
"""CPU seconds of reading a view of a dataset, and of drawing a pixel of a street."""
PROCESS_BYTES, VIEW_BYTES = 0.8e9, 40.0
"""Memory of a process, and of each view for its width squared."""
KEPT_BYTES, KEPT_VIEW_BYTES = 2e6, 12.0
"""What is stored of a sequence, and of each view for its width squared."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Effort:
    """What a sequence takes on the reference machine."""

    cpu_seconds: float
    memory_bytes: float
    num_bytes: float

    def to_json(self) -> str:
        """Return it as the catalog keeps it."""
        return json.dumps(asdict(self))

    @classmethod
    def from_json(cls, text: str) -> Self | None:
        """Read what the catalog kept; None where another version of this program wrote it."""
        values = json.loads(text)
        names = {field.name for field in fields(cls)}
        return cls(**values) if values.keys() == names else None


@dataclass(frozen=True, slots=True, kw_only=True)
class Prediction:
    """What a sequence is thought to take; None where nothing tells."""

    seconds: float | None = None
    cpu_seconds: float | None = None
    """Without compiling kernels."""
    memory_bytes: float | None = None
    num_bytes: float | None = None

    def facts(self) -> dict[str, Any]:
        """Return it as a lease carries it to the catalog."""
        sizes = {"memory_bytes": self.memory_bytes, "num_bytes": self.num_bytes}
        rounded = {name: None if size is None else round(size) for name, size in sizes.items()}
        facts = {"seconds": self.seconds, "cpu_seconds": self.cpu_seconds, **rounded}
        return {f"predicted_{name}": value for name, value in facts.items()}


class ResourceForecast:
    """Predicts from the attempts of one store."""

    def __init__(self, attempts: Sequence[Row], scenes: Sequence[Row]) -> None:
        """Learn from rows of the tables, of scenes whose views are known."""
        self._scenes = {row["scene_id"]: row for row in scenes}
        done = [row for row in attempts if row["cause"] == "done" and row["effort"]]
        newest = sorted(done, key=lambda row: row["ended_at"])[-MOST_ATTEMPTS:]
        efforts = ((row, Effort.from_json(row["effort"])) for row in newest)
        self._past = [(row, effort) for row, effort in efforts if effort is not None]

    @classmethod
    def of(cls, store: Store) -> Self:
        """Learn from what a store holds now."""
        return cls(store.tables.rows("attempts"), store.tables.rows("scenes"))

    def predict(self, asked: Asked) -> Prediction:
        """Return what a sequence will take."""
        effort = self.effort(asked)
        if effort is None or not self._past:
            return Prediction()
        cpu, more_memory, size = self._corrections
        return Prediction(
            seconds=effort.cpu_seconds * cpu * self._wall_ratio,
            cpu_seconds=effort.cpu_seconds * cpu,
            memory_bytes=max(effort.memory_bytes + more_memory, 0.0),
            num_bytes=effort.num_bytes * size,
        )

    def effort(self, asked: Asked) -> Effort | None:
        """Return what a sequence takes elsewhere; None where its views cannot be counted."""
        views = self._num_views(asked)
        if views is None:
            return None
        parameters, making_s = asked.parameters, 0.0
        if asked.seed is not None:
            seen = parameters.observation  # images are never enlarged
            seen = replace(seen, width_px=min(seen.width_px, asked.street.width_px))
            parameters = parameters.model_copy(update={"observation": seen})
        if asked.scene_id not in self._scenes:
            making_s = views * READ_VIEW_S
            if asked.seed is not None:
                drawn = asked.street.num_frames * len(asked.street.cameras)
                making_s = drawn * float(asked.street.width_px) ** 2 * DRAWN_PIXEL_S
        squared = views * float(parameters.observation.width_px) ** 2
        return Effort(
            cpu_seconds=making_s + sum(reference_seconds(parameters, views).values()),
            memory_bytes=PROCESS_BYTES + VIEW_BYTES * squared,
            num_bytes=KEPT_BYTES + KEPT_VIEW_BYTES * squared,
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
    def _corrections(self) -> tuple[float, float, float]:
        """By which factor CPU seconds and stored bytes were more, and by how much memory was."""
        cpu = [
            math.log(own_cpu_seconds(r) / e.cpu_seconds)
            for r, e in self._past
            if own_cpu_seconds(r) > 0
        ]
        memory = [
            r["peak_memory_bytes"] - e.memory_bytes for r, e in self._past if r["peak_memory_bytes"]
        ]
        size = [math.log(r["num_bytes"] / e.num_bytes) for r, e in self._past if r["num_bytes"]]
        return math.exp(_recent_mean(cpu)), _recent_mean(memory), math.exp(_recent_mean(size))

    @cached_property
    def _wall_ratio(self) -> float:
        """Wall to CPU time of the newest attempts, those of this machine if there are any."""
        rows = [row for row, _ in self._past]
        here = [row for row in rows if row["worker"].rpartition(":")[0] == platform.node()]
        newest = (here or rows)[-RECENT:]
        return median(row["seconds"] / max(row["cpu_seconds"] or 0.0, 1e-3) for row in newest)


def own_cpu_seconds(attempt: Mapping[str, Any]) -> float:
    """Return what a sequence took by itself: without compiling kernels for it and all after it."""
    return (attempt["cpu_seconds"] or 0.0) - (attempt["compile_seconds"] or 0.0)


def forecast_error(attempts: Iterable[Mapping[str, Any]]) -> float | None:
    """Return how far off the predicted CPU seconds were, as a share of the true ones.

    It is the median of the newest attempts that were predicted; those that were recalled or
    continued what others had begun do not count. None where there is none.
    """
    shares = [
        abs(row["predicted_cpu_seconds"] - own_cpu_seconds(row)) / own_cpu_seconds(row)
        for row in sorted(attempts, key=lambda row: row["ended_at"])
        if row["cause"] == "done" and row["effort"] and row["predicted_cpu_seconds"]
    ]
    return median(shares[-RECENT:]) if shares else None


def _recent_mean(values: Sequence[float]) -> float:
    """The mean of values, oldest first, of which later ones count more; 0 of none."""
    counts = [0.5 ** (age / HALF_LIFE) for age in reversed(range(len(values)))]
    return sum(c * value for c, value in zip(counts, values, strict=True)) / (sum(counts) or 1.0)
