"""How long the stages of a run take: the one model behind progress lines and fleets.

What a stage takes on a known machine follows from the size of the run (`reference_seconds`). Past
runs of the store tell how much longer each kind of stage takes on this one (`expected_seconds`),
and the present run corrects both by how fast it is (`Clock`). What the first run on a machine
compiles comes on top; how much that is its first stage tells.
"""

import json
import math
import time
from bisect import bisect_left
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from math import ceil
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from flows.parameters import ReconstructParameters

WHOLE_VIEWS = 0.33
"""A training view's part of new surface, about: the fit finds out and corrects it."""
COMPILING_S = {
    "prepare": 14.0,
    "fit": 85.0,
    "paint-1": 3.4,
    "examine": 4.7,
    "evaluate-unpainted": 3.7,
}
"""Compiling the kernels of each stage where none is kept, in seconds of the reference machine."""
LEAST_SHARE = 0.02
"""Part of a stage after which its own speed is believed."""
TRUSTED_SHARE = 0.2
"""Part of a fit after which nothing but its own speed is believed."""
PRIOR_SHARE = 0.03
"""Part of a run that must be over before its own pace counts as much as what was expected."""
MOST_COMPILED_S = 0.5
"""Compiling in one part of a stage, from which on that part says nothing about the speed."""
FIRST_SHARE = 0.17
"""Part of a run after which its end is foretold where no past run tells."""


def reference_seconds(
    parameters: "ReconstructParameters", num_views: float, num_recorded: float | None = None
) -> dict[str, float]:
    """Return what every stage of a run takes on one core of the reference machine, in order.

    Weights were measured on PandaSet 002 and KITTI 0005, 480 pixels wide, and a synthetic street of
    160, 10 to 16 training views; kernels are compiled already. `num_views` are recorded images of
    its cameras, `num_recorded` those of all cameras of the recording.
    """
    pixels = parameters.observation.width_px**2 * 9 / 16
    train = num_views if parameters.split == "all" else num_views / 2
    test = min(num_views - train or train, parameters.scoring.most_views or num_views)
    whole_views = max(WHOLE_VIEWS * train, 1.0)

    def steps(name: str) -> float:
        return getattr(parameters, name).most_steps(whole_views)

    has_truth = parameters.scene.startswith("synthetic/")  # views beside the path are drawn too
    paints = any(name.startswith("paint-") for name in parameters.stages)
    shifts = parameters.novel.in_round(1, max(parameters.rounds, 1)).shifts
    turns = len(parameters.train_cameras or ()) == 1  # else most turned views are another camera's
    of_round = sum(turns or bool(shift.lateral_m or shift.up_m) for shift in shifts)
    painted = ceil(train / parameters.novel.every_nth) * of_round
    step_s = 0.005 + 2.6e-7 * pixels
    truths_s = 1.0 + 5e-6 * pixels if has_truth else 0.0
    kinds = {
        "prepare": num_views * (0.35 + 1.6e-6 * pixels),
        "fit": 2.0 + 0.15 * train + steps("fit") * step_s,
        "paint": painted * (0.1 + 6e-6 * pixels),
        "refine": steps("refine") * step_s * (2.0 if paints else 1.0) + (6.0 if paints else 0.0),
        "examine": 6.0 + 0.27 * (num_recorded or num_views),
        "evaluate": test * (0.3 + 1.2e-6 * pixels + truths_s),
        "envelope": 0.5 + test * (0.15 + 2.3e-6 * pixels),
        "lidar": 20.0 + 7.0 * train / max(len(parameters.train_cameras or ()), 1),
        "report": 1.5 + 4e-5 * pixels,
    }
    told = {name: kinds[_kind(name)] for name in parameters.stages}
    if has_truth and (first := next((n for n in told if _kind(n) == "evaluate"), None)):
        told[first] += test * 2e-5 * pixels  # it draws what the others compare with
    return told


def expected_seconds(
    parameters: "ReconstructParameters",
    num_views: float,
    past: Iterable[Mapping[str, Any]],
    num_recorded: float | None = None,
) -> tuple[dict[str, float], bool]:
    """Return what every stage of a run will take here, and whether a past run tells.

    Past runs are rows of the table `runs`, each with the `num_views` of its scene and cameras and
    the `num_recorded` of its scene, if they are known; the newest complete one with parameters of
    this version tells of each kind of stage.
    """
    from pydantic import ValidationError

    from flows.parameters import ReconstructParameters

    paces: dict[str, float] = {}
    complete = [row for row in past if row["status"] == "complete" and row["num_views"]]
    for row in sorted(complete, key=lambda row: row["finished_at"], reverse=True):
        try:
            were = ReconstructParameters.model_validate_json(row["parameters"] or "{}")
        except ValidationError:
            continue
        reference = reference_seconds(were, row["num_views"], row.get("num_recorded"))
        took = json.loads(row["stage_seconds"] or "{}")
        for kind in {_kind(name) for name in reference} - paces.keys():
            stages = [name for name in reference if _kind(name) == kind and name in took]
            if stages:
                paces[kind] = sum(took[s] for s in stages) / sum(reference[s] for s in stages)
    expected = reference_seconds(parameters, num_views, num_recorded)
    usual = sum(paces.values()) / len(paces) if paces else 1.0
    told = {name: seconds * paces.get(_kind(name), usual) for name, seconds in expected.items()}
    return told, bool(paces)


def _kind(stage: str) -> str:
    """The first word of a stage's name: rounds are alike, and so are evaluations."""
    return stage.partition("-")[0]


@dataclass(kw_only=True)
class Clock:
    """Follows the stages of a run; all times are in seconds."""

    expected: Mapping[str, float] = field(default_factory=dict)
    """What every stage will take, in order; empty where nothing is known of what comes."""
    is_told_by_past: bool = False
    """Whether that is known from past runs; the pace of this one tells else, after a while."""
    now: Callable[[], float] = time.monotonic
    compiled: Callable[[], float] = lambda: 0.0
    """How long kernels have been compiled so far: what is left of a stage needs no more of it."""
    _began: dict[str, float] = field(default_factory=dict)
    _compiled_before: dict[str, float] = field(default_factory=dict)
    _course: dict[str, list[tuple[float, float]]] = field(default_factory=dict)
    """By stage, how much was done after how much work; what only made ready for it is left out."""
    _compiled_at: dict[str, float] = field(default_factory=dict)
    """By stage, how much had been compiled when a part of it was told last."""
    _took: dict[str, tuple[float, float]] = field(default_factory=dict)
    """Work and compiling of stages that were computed."""
    _over: set[str] = field(default_factory=set)

    def started(self, stage: str) -> None:
        """A stage begins; `refine-1-unpainted`, which no plan knows, is like its round."""
        like = stage.rpartition("-")[0]
        if stage not in self.expected and like in self.expected:
            order = list(self.expected.items())
            place = list(self.expected).index(like) + 1
            order.insert(place, (stage, self.expected[like]))
            self.expected = dict(order)
        self._compiled_before[stage], self._began[stage] = self.compiled(), self.now()

    def advanced(self, stage: str, share: float) -> None:
        """So much of a stage is done, 0 to 1; told again, it has only made ready for its parts."""
        course, compiled = self._course.setdefault(stage, []), self._compiled(stage)
        is_ready = not (len(course) == 1 and course[0][0] == share)
        if not is_ready or compiled > self._compiled_at.get(stage, 0.0) + MOST_COMPILED_S:
            course.clear()  # nor does a part in which kernels were compiled tell of the speed
        self._compiled_at[stage] = compiled
        course.append((share, self._work(stage)))

    def finished(self, stage: str, *, is_new: bool) -> None:
        """A stage is over."""
        self._over.add(stage)
        if is_new:
            # what a first fit compiles without being counted is not what a round takes
            steady = self._speed(stage) if stage == "fit" else None
            work = min(self._work(stage), steady or math.inf)
            self._took[stage] = (work, self._compiled(stage))

    def place(self, stage: str) -> str:
        """Return such as `stage 4 of 11`; nothing where the stages to come are not known."""
        names = list(self.expected)
        return f"stage {names.index(stage) + 1} of {len(names)}" if stage in names else ""

    def elapsed(self, stage: str | None = None) -> float:
        """Return the seconds since a stage began, or the first one."""
        return self.now() - (self._began[stage] if stage else min(self._began.values()))

    def left(self, stage: str) -> float | None:
        """Return what is left of a stage; None where nothing tells, or more than that is gone."""
        if self._own(stage) is None and not self.is_told_by_past:
            return None
        left = self._left(stage)
        return left if left > 0 else None

    def run_left(self, stage: str) -> float | None:
        """Return what is left of the whole run in which this stage is; None as in `left`."""
        if stage not in self.expected:
            return None
        coming = [name for name in self.expected if name not in self._over and name != stage]
        left = self._left(stage) + sum(self._foretold(name) for name in coming)
        is_early = self.elapsed() < FIRST_SHARE * (self.elapsed() + left)
        return None if left <= 0 or (is_early and not self.is_told_by_past) else left

    def _left(self, stage: str) -> float:
        own, total = self._own(stage), self.expected.get(stage, 0.0) * self._pace(stage)
        if own is None:
            has_parts = any(share for share, _ in self._course.get(stage, ()))
            compiling = 0.0 if has_parts else self._coldness * COMPILING_S.get(stage, 0.0)
            compiling -= self._compiled(stage)
            return max(total - self._work(stage), 0.0) + max(compiling, 0.0)
        # an expectation knows that steps grow slower; it gives way as the stage shows itself
        share = self._trust(stage) if total else 1.0
        return max(share * own + (1 - share) * total - self._work(stage), 0.0)

    def _foretold(self, stage: str) -> float:
        """What a stage that has not begun will take."""
        work = self.expected[stage] * self._pace(stage)
        return work + self._coldness * COMPILING_S.get(stage, 0.0)

    def _pace(self, like: str) -> float:
        """Seconds of work for an expected one, in stages like this one.

        Rounds tell of rounds, and evaluations of evaluations. Without a past run fits are apart
        from the rest: how many steps they have is found out by the first.
        """
        same = [name for name in self._took if _kind(name) == _kind(like) and name in self.expected]
        every = [n for n in self.expected if self.is_told_by_past or _group(n) == _group(like)]
        alike = same or every
        took = known = 0.0 if same else PRIOR_SHARE * sum(self.expected.values())
        for name in alike:
            if name in self._took:
                took, known = took + self._took[name][0], known + self.expected[name]
            elif name not in self._over and (speed := self._speed(name)) is not None:
                share = self._trust(name)
                took, known = took + share * speed, known + share * self.expected[name]
        return took / known if known else 1.0

    @property
    def _coldness(self) -> float:
        """How much has been compiled of what compiles where nothing is kept, by what is over."""
        over = [name for name in self._took if name in COMPILING_S]
        all_of_it = sum(COMPILING_S[name] for name in over)
        return sum(self._took[name][1] for name in over) / all_of_it if over else 0.0

    def _trust(self, stage: str) -> float:
        """How much a stage's own speed counts: only parts of the first fit are many and alike."""
        share = self._course[stage][-1][0]
        return min(share / TRUSTED_SHARE, 1.0) if stage == "fit" else share**2

    def _own(self, stage: str) -> float | None:
        """What work a stage is in all, by the parts it has done; None before it has done any."""
        speed = self._speed(stage)
        if speed is None:
            return None
        share, done = self._course[stage][-1]
        return done + speed * (1 - share)

    def _speed(self, stage: str) -> float | None:
        """Seconds of work that all of a stage takes as it goes now; None before it has begun."""
        course = self._course.get(stage)
        if not course or course[-1][0] - course[0][0] < LEAST_SHARE:
            return None
        share, done = course[-1]
        # what first steps compile and fetch does not come again: the latter half tells
        first, began = course[bisect_left(course, ((share + course[0][0]) / 2,))]
        if share - first < LEAST_SHARE:
            first, began = course[0]
        return (done - began) / (share - first)

    def _work(self, stage: str) -> float:
        """How long a stage has gone on without compiling kernels."""
        return self.elapsed(stage) - self._compiled(stage)

    def _compiled(self, stage: str) -> float:
        """How long kernels have been compiled since a stage began."""
        return self.compiled() - self._compiled_before[stage]


def _group(stage: str) -> str:
    """Stages that tell of one another's pace; to examine takes as long as a recording is large."""
    is_fit = _kind(stage) in ("fit", "refine")
    return "fit" if is_fit else "examine" if stage == "examine" else "rest"


def as_clock(seconds: float) -> str:
    """Return minutes and seconds, with hours where there are any: 3:10, 1:02:05."""
    minutes, rest = divmod(round(max(seconds, 1.0)), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{rest:02}" if hours else f"{minutes}:{rest:02}"
