"""Stability where methods fail: one cause at a time, with and without painting."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from catalog.points import Point
from catalog.store import Store
from flows.fleet.manifest import Configuration
from flows.measure.chart import rows_of
from flows.measure.figures import LABELS, groups_of
from lidarpainter_models.evaluation.fronts import Spread
from lidarpainter_models.export.charts import Line, draw_lines
from lidarpainter_models.stress.causes import CAUSES, cause_of
from tasks.ingest.spoil import ingest_spoilt, spoilt_id
from tasks.opened import open_scene

PAINTED, UNPAINTED = "painted", "unpainted"
WAYS = (
    Configuration(name=PAINTED),
    Configuration(name=UNPAINTED, painter="none"),
)
"""The unpainted scene is fitted as long."""
QUALITIES = ("aside_psnr", "recorded_psnr")
HARM_DB = 0.1
"""Painting that costs more hurts."""


@dataclass(frozen=True, kw_only=True)
class Trial:
    """A recording with a fault."""

    scene: str
    """As recorded."""
    cause: str
    level: float
    spoilt: str
    """Its scene id."""


def trials_of(
    store: Store, scenes: Sequence[str], causes: Sequence[str], num_levels: int
) -> list[Trial]:
    """Every cause at so many levels, from mild on, of those that a scene has.

    Raises:
        ConfigError: there is no such cause.
    """
    opened = {scene: open_scene(store, scene) for scene in scenes}
    return [
        Trial(
            scene=scene,
            cause=name,
            level=level,
            spoilt=spoilt_id(opened[scene], name, level),
        )
        for name in causes
        for scene in scenes
        for level in cause_of(name).levels_of(len(opened[scene].camera_names))[:num_levels]
    ]


def spoil_scenes(store: Store, trials: Sequence[Trial]) -> None:
    """Write the recordings of all trials, unless they are there."""
    for trial in trials:
        ingest_spoilt.fn(store.address, trial.scene, trial.cause, trial.level)


def stress_of(points: Sequence[Point], trials: Sequence[Trial], out: Path) -> dict[str, Any]:
    """Draw every cause with and without painting.

    The points are of all trials, and of the scenes as recorded.

    Returns:
        What `stress --json` prints: `points`, `pictures`, and what they say.
    """
    figures = {(group.scene, group.configuration): group.figures for group in groups_of(points)}
    pictures, says = [], []
    for quality in QUALITIES:
        scenes = [
            scene
            for scene in dict.fromkeys(trial.scene for trial in trials)
            if quality in figures.get((scene, PAINTED), {})
        ]
        panels = {
            f"{cause}, {scene}": lines
            for cause in dict.fromkeys(trial.cause for trial in trials)
            for scene in scenes
            if (lines := _lines(trials, cause, scene, figures, quality))
        }
        if panels:
            stem = out / f"stress-{quality}"
            pictures += draw_lines(panels, LABELS[quality], stem, columns=_columns(len(scenes)))
            says += _told(panels, quality)
    return {"points": rows_of(points), "pictures": list(map(str, pictures)), "says": says}


def _columns(num_scenes: int) -> int:
    """So many that those of a scene stand below each other, about four."""
    return num_scenes * max(4 // num_scenes, 1)


def _lines(
    trials: Sequence[Trial],
    cause: str,
    scene: str,
    figures: Mapping[tuple[str, str], Mapping[str, Spread]],
    quality: str,
) -> list[Line]:
    """A line for each way, from the scene as recorded on; none where the cause has no level."""
    spoilt = [t for t in trials if (t.cause, t.scene) == (cause, scene)]
    steps = [("none", scene), *((f"{t.level:g}", t.spoilt) for t in spoilt)]
    lines = []
    for way in (PAINTED, UNPAINTED):
        known = [
            (level, figures[name, way][quality])
            for level, name in steps
            if quality in figures.get((name, way), {})
        ]
        levels, values = [level for level, _ in known], [value for _, value in known]
        lines.append(Line(name=way, levels=levels, values=values))
    return lines if spoilt else []


def _told(panels: Mapping[str, Sequence[Line]], quality: str) -> list[str]:
    """By cause: where the lead of painting is halved, where it hurts; the worst case last."""
    says, worst = [], (0.0, "")
    for title, (painted, unpainted) in panels.items():
        gains = [a.mean - b.mean for a, b in zip(painted.values, unpainted.values, strict=True)]
        levels = painted.levels
        unit = CAUSES[title.split(",")[0]].unit
        halved = next((lv for lv, g in zip(levels, gains, strict=True) if g < gains[0] / 2), None)
        hurts = next((lv for lv, g in zip(levels, gains, strict=True) if g < -HARM_DB), None)
        says.append(
            f"{title}, {LABELS[quality]}: gains {gains[0]:+.2f} as recorded, {gains[-1]:+.2f} at "
            f"{levels[-1]} {unit}; halved at {halved or 'none'}, hurts at {hurts or 'none'}"
        )
        worst = min(worst, (min(gains), f"{title} at {levels[gains.index(min(gains))]} {unit}"))
    return [
        *says,
        f"{LABELS[quality]}: painting costs most {worst[0]:+.2f} ({worst[1] or 'never'})",
    ]
