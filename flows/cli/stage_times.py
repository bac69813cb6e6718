"""How long a stage and the whole run still take: by past runs, and by how fast this one goes.

A stage goes on at the speed it has shown. Before that, and for the stages that come after it, the
newest past run of the same preset tells, in proportion to steps (fits for which they are set) or
views (all else), and to how much faster or slower this run is than that one so far. Where nothing
tells, nothing is said.
"""

import json
import re
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

LEAST_SHARE = 0.02
"""Part of a stage after which its own speed is believed."""
FITS = ("fit", "refine")
PRIOR_SHARE = 0.03
"""Part of a run that must be over before its own pace counts as much as that of the past one."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PlannedStage:
    """A stage that a run will go through."""

    name: str
    amount: float
    """What its time grows with: steps of a fit where they are set, views of anything else."""
    has_steps: bool = False


def expected_seconds(
    stages: Sequence[PlannedStage], preset: str, past: Iterable[Mapping[str, Any]]
) -> dict[str, float] | None:
    """Seconds of every stage in order, by the newest past run that tells; None without one.

    Args:
        stages: of the run that begins.
        preset: it started from.
        past: rows of the table `runs`, each with `num_views` of its scene.
    """
    complete = [row for row in past if row["status"] == "complete" and row["preset"] == preset]
    for row in sorted(complete, key=lambda row: row["finished_at"], reverse=True):
        rates = _rates(row)
        kinds = [(_kind(stage.name), stage.has_steps) for stage in stages]
        if all(kind in rates for kind in kinds):
            amounts = zip(stages, kinds, strict=True)
            return {stage.name: rates[kind] * stage.amount for stage, kind in amounts}
    return None


def _rates(row: Mapping[str, Any]) -> dict[tuple[str, bool], float]:
    """Seconds for a view or a step, by kind of stage and which of them, as far as a run tells."""
    parameters = json.loads(row["parameters"] or "{}")
    took: dict[str, list[float]] = {}
    for name, seconds in json.loads(row["stage_seconds"] or "{}").items():
        took.setdefault(_kind(name), []).append(seconds)
    steps = {kind: parameters.get(kind, {}).get("steps") for kind in FITS}
    return {
        (kind, bool(steps.get(kind))): sum(seconds) / len(seconds) / amount
        for kind, seconds in took.items()
        if (amount := steps.get(kind) or row["num_views"])
    }


def _kind(stage: str) -> str:
    """The name without the number of its round: rounds are alike."""
    return re.sub(r"-\d+$", "", stage)


@dataclass(kw_only=True)
class Clock:
    """Follows the stages of a run; all times are in seconds."""

    expected: Mapping[str, float] = field(default_factory=dict)
    """By stage, in order; empty where no past run tells."""
    now: Callable[[], float] = time.monotonic
    compiled: Callable[[], float] = lambda: 0.0
    """How long kernels have been compiled so far: what is left of a stage needs no more of it."""
    _began: dict[str, float] = field(default_factory=dict)
    _compiled_before: dict[str, float] = field(default_factory=dict)
    _first: dict[str, tuple[float, float]] = field(default_factory=dict)
    """Of a stage: how much was done when its parts began, and after how much work that was."""
    _last: dict[str, tuple[float, float]] = field(default_factory=dict)
    """How much is done, and after how much work that was so."""
    _took: dict[str, float] = field(default_factory=dict)
    """Of stages that were computed."""
    _over: set[str] = field(default_factory=set)

    def started(self, stage: str) -> None:
        """A stage begins; `refine-1-unpainted`, which no plan knows, is like its round."""
        like = stage.rpartition("-")[0]
        if stage not in self.expected and like in self.expected:
            self.expected = {**self.expected, stage: self.expected[like]}
        self._compiled_before[stage], self._began[stage] = self.compiled(), self.now()

    def advanced(self, stage: str, share: float) -> None:
        """So much of a stage is done, 0 to 1; told again, it has only made ready for its parts."""
        self._last[stage] = (share, self.elapsed(stage) - self._compiled(stage))
        if self._first.setdefault(stage, self._last[stage])[0] == share:
            self._first[stage] = self._last[stage]

    def finished(self, stage: str, *, is_new: bool) -> None:
        """A stage is over."""
        self._over.add(stage)
        if is_new:
            self._took[stage] = self.elapsed(stage)

    def elapsed(self, stage: str | None = None) -> float:
        """Since a stage began, or the first one."""
        return self.now() - (self._began[stage] if stage else min(self._began.values()))

    def left(self, stage: str) -> float | None:
        """Of a stage; None where nothing tells, or more than was thought has passed."""
        known, own = self.expected.get(stage), self._own(stage)
        total = None if known is None else known * self._pace(stage)
        if own is not None:
            # an expectation knows that steps grow slower; it gives way as the stage shows itself
            share = 1.0 if total is None else self._last[stage][0]
            total = share * own + (1 - share) * (total or 0.0)
        if total is None or total <= self.elapsed(stage):
            return None
        return total - self.elapsed(stage)

    def run_left(self, stage: str) -> float | None:
        """Of the whole run, of which this stage goes on; None where nothing tells, as in `left`."""
        if stage not in self.expected:
            return None
        coming = sum(
            seconds
            for name, seconds in self.expected.items()
            if name not in self._over and name != stage
        )
        return ((self.left(stage) or 0.0) + coming * self._pace(stage)) or None

    def _pace(self, stage: str) -> float:
        """Seconds that this run takes for one that was expected."""
        took = known = PRIOR_SHARE * sum(self.expected.values())
        for name in self.expected.keys() & self._took.keys():
            took, known = took + self._took[name], known + self.expected[name]
        if (own := self._own(stage)) is not None:
            share = self._last[stage][0]
            took, known = took + share * own, known + share * self.expected[stage]
        return took / known if known else 1.0

    def _own(self, stage: str) -> float | None:
        """What a stage takes in all, by the parts it has done; None before it has done any."""
        if stage not in self._last:
            return None
        (first, began), (share, done) = self._first[stage], self._last[stage]
        if share - first < LEAST_SHARE:
            return None
        gone = done + self._compiled(stage)
        return gone + (done - began) / (share - first) * (1 - share)

    def _compiled(self, stage: str) -> float:
        """How long kernels have been compiled since a stage began."""
        return self.compiled() - self._compiled_before[stage]


def as_clock(seconds: float) -> str:
    """Minutes and seconds, with hours where there are any: 3:10, 1:02:05."""
    minutes, rest = divmod(round(max(seconds, 1.0)), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{rest:02}" if hours else f"{minutes}:{rest:02}"
