"""Stability where methods fail: one cause at a time, with and without painting."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from catalog.points import Point
from catalog.store import Store
from flows.fleet.manifest import Configuration, Publication
from flows.measure.chart import rows_of
from flows.measure.figures import LABELS, groups_of
from lidarpainter_models.evaluation.fronts import Spread
from lidarpainter_models.export.charts import Line, draw_lines
from lidarpainter_models.stress.causes import CAUSES, cause_of
from tasks.ingest.spoil import ingest_spoilt, spoilt_id
from tasks.opened import open_scene

PAINTED, UNPAINTED = "painted", "unpainted"
WAYS = (Configuration(name=PAINTED), Configuration(name=UNPAINTED, painter="none"))
"""The unpainted scene is fitted as long."""
PUBLISHED: tuple[Publication, ...] = ("scores", "examination")
_NUMBER = re.compile(r"[-+]?\d+(\.\d+)?")
_Trials = Mapping[int, Mapping[str, float]]
"""Figures by seed."""
HARM = {"aside_psnr": 0.1, "recorded_psnr": 0.1, "lidar_within": 0.01, "markings_auc": 0.01}
"""Painting that costs more of a quality hurts: decibels, and parts of one."""
SEEDS_IN_DOUBT = 3
"""Where it seems to. With one seed a difference of two fits is off by up to that by chance."""


@dataclass(frozen=True, kw_only=True)
class Trial:
    """A recording with a fault."""

    scene: str
    """Id of the scene as recorded."""
    cause: str
    level: float
    spoilt: str
    """Id of the scene with the fault."""


def trials_of(
    store: Store, scenes: Sequence[str], causes: Sequence[str], num_levels: int
) -> list[Trial]:
    """Every cause at so many levels, from mild on, of those that a scene has.

    Raises:
        ConfigError: there is no such cause.
    """
    opened = {scene: open_scene(store, scene) for scene in scenes}
    return [
        Trial(scene=scene, cause=name, level=level, spoilt=spoilt_id(opened[scene], name, level))
        for name in causes
        for scene in scenes
        for level in cause_of(name).levels_of(len(opened[scene].camera_names))[:num_levels]
    ]


def spoil_scenes(store: Store, trials: Sequence[Trial]) -> None:
    """Write the recordings of all trials, unless they are there."""
    for trial in trials:
        ingest_spoilt.fn(store.address, trial.scene, trial.cause, trial.level)


def in_doubt(points: Sequence[Point], trials: Sequence[Trial]) -> list[str]:
    """The spoilt scenes that painting seems to harm, made with too few seeds to say so."""
    groups = {(group.scene, group.configuration): group for group in groups_of(points)}
    found = []
    for scene in dict.fromkeys(trial.spoilt for trial in trials):
        painted, unpainted = (groups.get((scene, way)) for way in (PAINTED, UNPAINTED))
        if painted is None or unpainted is None or len(painted.trials) >= SEEDS_IN_DOUBT:
            continue
        shared = HARM.keys() & painted.figures.keys() & unpainted.figures.keys()
        gains = {one: painted.figures[one].mean - unpainted.figures[one].mean for one in shared}
        if any(gain < -HARM[one] for one, gain in gains.items()):
            found.append(scene)
    return found


def stress_of(points: Sequence[Point], trials: Sequence[Trial], out: Path) -> dict[str, Any]:
    """Draw every cause with and without painting.

    The points are of all trials, and of the scenes as recorded.

    Returns:
        What `stress --json` prints: `points`, `pictures`, the `curves` in them, what they say, and
        where the `table` of all curves lies.
    """
    figures = {(group.scene, group.configuration): group.trials for group in groups_of(points)}
    causes = dict.fromkeys(trial.cause for trial in trials)
    pictures, drawn, says = [], [], []
    by_quality = {
        quality: [one for cause in causes for one in _curves(trials, cause, figures, quality)]
        for quality in HARM
    }
    by_quality = {quality: curves for quality, curves in by_quality.items() if curves}
    for quality, curves in by_quality.items():
        for what, label, lines_of, are_gains in (
            (quality, LABELS[quality], _as_it_falls, False),
            (f"gain-{quality}", f"{LABELS[quality]}: what painting gains", _as_it_gains, True),
        ):
            panels = {
                f"{cause}, {CAUSES[cause].unit}": [
                    line for curve in curves if curve.cause == cause for line in lines_of(curve)
                ]
                for cause in causes
            }
            pictures += draw_lines(panels, label, out / f"stress-{what}", are_gains=are_gains)
        drawn += [_row(curve, quality) for curve in curves]
        says += _told(curves, quality)
    table = out / "stress.md"
    out.mkdir(parents=True, exist_ok=True)
    table.write_text(_table(by_quality))
    return {
        "points": rows_of(points),
        "pictures": list(map(str, pictures)),
        "curves": drawn,
        "table": str(table),
        "says": _noticed(points, trials) + says,
    }


def _noticed(points: Sequence[Point], trials: Sequence[Trial]) -> list[str]:
    """Sentences by cause: from which level on the system notices that a recording is spoilt."""
    said = {point.scene: point.suspicions for point in points if point.suspicions is not None}
    lines = []
    for cause, scene in dict.fromkeys((t.cause, t.scene) for t in trials if t.spoilt in said):
        levels = [t for t in trials if (t.cause, t.scene) == (cause, scene) and t.spoilt in said]
        news = {t.level: new_suspicions(said[t.spoilt], said.get(scene, ())) for t in levels}
        first = next((level for level, new in news.items() if new), None)
        told = (
            "not noticed"
            if first is None
            else f"noticed from {first:g} {CAUSES[cause].unit} on: {news[first][0]}"
        )
        lines.append(f"{cause}, {scene}: {told}")
    return lines


def new_suspicions(said: Sequence[str], as_recorded: Sequence[str]) -> list[str]:
    """The statements of suspicions that are not there as recorded, whatever their numbers."""
    known = {_NUMBER.sub("#", part) for part in _statements(as_recorded)}
    return [part for part in _statements(said) if _NUMBER.sub("#", part) not in known]


def _statements(suspicions: Sequence[str]) -> list[str]:
    """Each with the name of what found it."""
    found = []
    for one in suspicions:
        name, _, detail = one.rstrip(".").partition(": ")
        found += [f"{name}: {part}" for part in detail.split("; ")]
    return found


@dataclass(frozen=True, kw_only=True)
class _Curve:
    """A figure of a scene over the levels of a cause, from the scene as recorded on."""

    cause: str
    scene: str
    number: int
    """Number of the scene among all, which decides its colour."""
    levels: list[str]
    painted: list[Spread]
    unpainted: list[Spread]
    gains: list[Spread]
    """What painting gains: means over pairs of one seed."""


def _curves(
    trials: Sequence[Trial], cause: str, figures: Mapping[tuple[str, str], _Trials], quality: str
) -> list[_Curve]:
    """The curves of all scenes that have the cause and the figure."""
    curves = []
    for number, scene in enumerate(dict.fromkeys(trial.scene for trial in trials)):
        spoilt = [t for t in trials if (t.cause, t.scene) == (cause, scene)]
        steps = [("none", scene), *((f"{t.level:g}", t.spoilt) for t in spoilt)]
        pairs = {level: _pairs(figures, name, quality) for level, name in steps}
        known = {level: pair for level, pair in pairs.items() if pair}
        if spoilt and known:
            curves.append(
                _Curve(
                    cause=cause,
                    scene=scene,
                    number=number,
                    levels=list(known),
                    painted=[Spread.of([ours for ours, _ in pair]) for pair in known.values()],
                    unpainted=[Spread.of([own for _, own in pair]) for pair in known.values()],
                    gains=[Spread.of([a - b for a, b in pair]) for pair in known.values()],
                )
            )
    return curves


def _pairs(
    figures: Mapping[tuple[str, str], _Trials], scene: str, quality: str
) -> list[tuple[float, float]]:
    """A figure with painting and without, of every seed that has both."""
    painted, unpainted = (figures.get((scene, way), {}) for way in (PAINTED, UNPAINTED))
    return [
        (painted[seed][quality], unpainted[seed][quality])
        for seed in sorted(painted.keys() & unpainted.keys())
        if quality in painted[seed] and quality in unpainted[seed]
    ]


def _row(curve: _Curve, quality: str) -> dict[str, Any]:
    return {
        "cause": curve.cause,
        "scene": curve.scene,
        "quality": quality,
        "levels": curve.levels,
        PAINTED: [value.mean for value in curve.painted],
        UNPAINTED: [value.mean for value in curve.unpainted],
    }


def _table(by_quality: Mapping[str, Sequence[_Curve]]) -> str:
    """In Markdown, a row for each cause: the painted figure at the gravest level, and the gains."""
    cells: dict[str, dict[str, str]] = {}
    for quality, curves in by_quality.items():
        for curve in curves:
            column, unit = f"{curve.scene}: {LABELS[quality]}", CAUSES[curve.cause].unit
            row = f"{curve.cause}, {' '.join(curve.levels[1:])} {unit}"
            form = ".1f" if _is_in_db(quality) else ".3f"
            gains = [_gain(gain.mean, quality) for gain in curve.gains]
            first, *_, last = (f"{one.mean:{form}}" for one in (*curve.painted, curve.painted[-1]))
            cells.setdefault("as recorded", {})[column] = f"{first}, {gains[0]}"
            if len(gains) > 1:
                cells.setdefault(row, {})[column] = f"{last}, {' '.join(gains[1:])}"
    columns = list(dict.fromkeys(column for row in cells.values() for column in row))
    rows = [["cause, levels", *columns], ["---"] * (1 + len(columns))]
    rows += [[name, *(row.get(column, "") for column in columns)] for name, row in cells.items()]
    return "".join(f"| {' | '.join(row)} |\n" for row in rows)


def _as_it_falls(curve: _Curve) -> list[Line]:
    ways = ((PAINTED, curve.painted), (UNPAINTED, curve.unpainted))
    return [
        Line(
            name=f"{curve.scene}, {name}",
            levels=curve.levels,
            values=values,
            colour=curve.number,
            is_dashed=name == UNPAINTED,
        )
        for name, values in ways
    ]


def _as_it_gains(curve: _Curve) -> list[Line]:
    return [Line(name=curve.scene, levels=curve.levels, values=curve.gains, colour=curve.number)]


def _told(curves: Sequence[_Curve], quality: str) -> list[str]:
    """Sentences by cause: where the lead of painting is halved, where it hurts; the worst last."""
    says, worst = [], (0.0, "")
    for curve in curves:
        gains, levels = [gain.mean for gain in curve.gains], curve.levels
        title, unit = f"{curve.cause}, {curve.scene}", CAUSES[curve.cause].unit
        named = list(zip(["as recorded", *levels[1:]], gains, strict=True))
        halved = next((level for level, gain in named if gain < gains[0] / 2), "no level")
        hurts = next((level for level, gain in named if gain < -HARM[quality]), "no level")
        lead = f"halved at {halved}" if gains[0] > 0 else "no lead to halve"
        says.append(
            f"{title}, {LABELS[quality]}: gains {_gain(gains[0], quality)} as recorded, "
            f"{_gain(gains[-1], quality)} at {levels[-1]} {unit}; {lead}, hurts at {hurts}"
        )
        worst = min(worst, (min(gains), f"{title} at {levels[gains.index(min(gains))]} {unit}"))
    spoilt = [gain.mean for curve in curves for gain in curve.gains[1:]]
    harmed = sum(gain < -HARM[quality] for gain in spoilt)
    most = f"{HARM[quality]:g}{' dB' if _is_in_db(quality) else ''}"
    costs, gain = f"{LABELS[quality]}: painting costs", _gain(worst[0], quality)
    return [
        *says,
        f"{costs} more than {most} at {harmed} of {len(spoilt)} levels",
        f"{costs} most {gain} ({worst[1] or 'never'})",
    ]


def _is_in_db(quality: str) -> bool:
    return quality.endswith("psnr")


def _gain(gain: float, quality: str) -> str:
    return f"{gain:+.2f}" if _is_in_db(quality) else f"{gain:+.3f}"
