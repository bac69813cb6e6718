"""Speed against accuracy: every configuration a point, drawn, and said in words."""

from collections.abc import Iterable, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

from catalog.points import Point
from flows.measure.configurations import DEFAULT, Factor
from flows.measure.figures import COSTS, LABELS, QUALITIES, Group, groups_of
from lidarpainter_models.evaluation.fronts import Spread, beats, knee, paired_gain, pareto_front
from lidarpainter_models.export.charts import Chart, Mark, draw_chart, write_chart_page

DRAWN = ("recorded_psnr", "aside_psnr", "aside_depth", "lidar_within", "markings_auc")
"""Rows of panels; more of each is better."""
TIME = "cpu_seconds"


def chart_of(points: Sequence[Point], out: Path) -> dict[str, Any]:
    """Draw speed against accuracy.

    Returns:
        What `chart --json` prints: `points`, `pictures`, and what they say.
    """
    groups = groups_of(points)
    drawn = _known(groups, DRAWN)
    chart = _chart("Speed against accuracy", groups, named=DEFAULT)
    page = write_chart_page(chart, COSTS, _known(groups, QUALITIES), out / "chart.html")
    pictures = [*draw_chart(chart, TIME, drawn, out / "chart"), page]
    return {
        "points": rows_of(points),
        "pictures": list(map(str, pictures)),
        "says": [says for name in drawn for says in _fronts(groups, name)],
    }


def sizes_of(points: Sequence[Point], factors: Sequence[Factor], out: Path) -> dict[str, Any]:
    """Draw quality against how much of each thing there is.

    Returns:
        What `size --json` prints: `points`, `pictures`, and what they say.
    """
    pictures, says = [], []
    for factor in factors:
        names = [level.name for level in factor.levels]
        groups = groups_of([point for point in points if point.configuration in names])
        drawn = _known(groups, DRAWN)
        chart = _chart(f"Quality against {factor.name}", groups, named=factor.default)
        pictures += draw_chart(chart, factor.cost, drawn, out / f"size-{factor.name}")
        says += [one for name in drawn for one in _returns(groups, factor, name)]
    return {"points": rows_of(points), "pictures": list(map(str, pictures)), "says": says}


def rows_of(points: Sequence[Point]) -> list[dict[str, Any]]:
    """Points as JSON: which, and every figure."""
    return [
        {
            "configuration": point.configuration,
            "scene": point.scene,
            "seed": point.seed,
            "run_id": point.run_id,
            **group.trials[point.seed],
        }
        for group in groups_of(points)
        for point in points
        if (point.scene, point.configuration) == (group.scene, group.configuration)
    ]


def _chart(title: str, groups: Sequence[Group], named: str) -> Chart:
    panels: dict[str, list[Mark]] = {}
    for group in groups:
        name = group.configuration
        mark = Mark(name=name, is_named=name == named, figures=group.figures)
        panels.setdefault(group.scene, []).append(mark)
    return Chart(title=title, panels=panels, labels=LABELS)


def _known(groups: Sequence[Group], names: Iterable[str]) -> list[str]:
    """Those of some qualities that somebody has."""
    return [name for name in names if any(name in group.figures for group in groups)]


def _by_scene(groups: Sequence[Group], quality: str) -> Mapping[str, list[Group]]:
    found: dict[str, list[Group]] = {}
    for group in groups:
        if quality in group.figures:
            found.setdefault(group.scene, []).append(group)
    return found


def _fronts(groups: Sequence[Group], quality: str) -> list[str]:
    """For each scene: the front, its knee, and what beats the preset by more than the bars."""
    says = []
    for scene, found in _by_scene(groups, quality).items():
        costs = [group.figures[TIME].mean for group in found]
        values = [group.figures[quality].mean for group in found]
        front = pareto_front(costs, values)
        bend = knee([costs[i] for i in front], [values[i] for i in front])
        names = [found[i].configuration for i in front]
        says.append(f"{scene}, {LABELS[quality]}: front {', '.join(names)}; knee {names[bend]}")
        preset = next((one for one in found if one.configuration == DEFAULT), None)
        if preset is not None:
            cost, value = preset.figures[TIME], preset.figures[quality]
            better = [
                one.configuration
                for one in found
                if beats(one.figures[TIME], one.figures[quality], cost, value)
            ]
            told = ", ".join(better) or "nothing"
            says.append(f"{scene}, {LABELS[quality]}: faster and better than the preset: {told}")
    return says


def _returns(groups: Sequence[Group], factor: Factor, quality: str) -> list[str]:
    """For each scene: what each level gives over the one before."""
    says = []
    for scene, found in _by_scene(groups, quality).items():
        by_name = {group.configuration: group for group in found}
        ordered = [by_name[level.name] for level in factor.levels if level.name in by_name]
        steps = [
            f"{after.configuration} {_told(_gain(after, before, quality))}"
            for before, after in pairwise(ordered)
        ]
        says.append(f"{scene}, {LABELS[quality]}: {', '.join(steps)}")
    return says


def _gain(after: Group, before: Group, quality: str) -> Spread:
    seeds = sorted(after.trials.keys() & before.trials.keys())
    ours, theirs = ([one.trials[seed][quality] for seed in seeds] for one in (after, before))
    return paired_gain(ours, theirs)


def _told(gain: Spread) -> str:
    return f"{gain.mean:+.3g}{'' if gain.is_sure else ' (within the noise)'}"
