"""Quality against cost as pictures and as a page: configurations as points with their bars."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lidarpainter_models.errors import WriteError
from lidarpainter_models.evaluation.fronts import Spread, pareto_front

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

INK, SOFT, NAMED, FRONT = "#1f2430", "#7b8494", "#c2410c", "#94a3b8"
COLOURS = (NAMED, "#1d4ed8", "#15803d", "#7e22ce", INK)
COLUMNS = 4
"""How many small multiples stand side by side."""
NAME_PT = 7.5
NAME_OFFSETS = ((0, 6, "center"), (0, -13, "center"), (7, -3, "left"), (-7, -3, "right"))
"""Where a name may stand beside its point: points across and up, and the side that is held."""
PANEL_INCHES = (4.6, 3.4)
SALT = "lidarpainter"
"""Makes the ids in an SVG the same every time."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Mark:
    """One configuration in one panel."""

    name: str
    is_named: bool
    """Whether it is a preset or another default, which is set off."""
    figures: Mapping[str, Spread]


@dataclass(frozen=True, kw_only=True)
class Chart:
    """Panels side by side, a scene each, one below the other for each quality."""

    title: str
    panels: Mapping[str, Sequence[Mark]]
    """Marks by the name of their scene."""
    labels: Mapping[str, str]
    """What the axes say, by the name of a figure."""


def draw_chart(chart: Chart, cost: str, qualities: Sequence[str], stem: Path) -> list[Path]:
    """Draw qualities over one cost, as SVG and PNG; returns both files.

    Each quality has a row of panels; a panel where nobody knows it stays empty. `stem` has no
    suffix.

    Raises:
        WriteError: a file cannot be written.
    """
    import matplotlib as mpl
    from matplotlib.figure import Figure

    size = PANEL_INCHES[0] * len(chart.panels), PANEL_INCHES[1] * len(qualities)
    with mpl.rc_context({"svg.hashsalt": SALT, "font.size": 9, "axes.edgecolor": FRONT}):
        figure = Figure(figsize=size, layout="constrained")
        axes = figure.subplots(len(qualities), len(chart.panels), squeeze=False)
        for row, quality in enumerate(qualities):
            for column, (scene, marks) in enumerate(chart.panels.items()):
                _draw_panel(axes[row, column], marks, cost, quality)
                axes[row, column].set_title(scene if row == 0 else "", loc="left", color=INK)
            axes[row, 0].set_ylabel(chart.labels[quality], color=SOFT)
        figure.draw_without_rendering()  # now it is known where points come to lie
        for row, quality in enumerate(qualities):
            for column, marks in enumerate(chart.panels.values()):
                _name_points(axes[row, column], marks, (cost, quality), 72 / figure.dpi)
        for panel in axes[-1]:
            panel.set_xlabel(chart.labels[cost], color=SOFT)
        figure.suptitle(chart.title, x=0.01, ha="left", color=INK, fontsize=11)
        return _saved(figure, stem)


def _saved(figure: "Figure", stem: Path) -> list[Path]:
    paths = [stem.with_suffix(".svg"), stem.with_suffix(".png")]
    try:
        stem.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(paths[0], metadata={"Date": None})
        figure.savefig(paths[1], dpi=110)
    except OSError as error:
        raise WriteError(f"{error.filename or stem} cannot be written: {error}") from None
    return paths


def _draw_panel(axes: "Axes", marks: Sequence[Mark], cost: str, quality: str) -> None:
    from matplotlib.ticker import EngFormatter, LogLocator, NullLocator

    known = [mark for mark in marks if cost in mark.figures and quality in mark.figures]
    if not known:
        axes.axis("off")
        axes.text(0.5, 0.5, "not known here", transform=axes.transAxes, ha="center", color=SOFT)
        return
    axes.set_xscale("log")
    axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axes.xaxis.set_major_formatter(EngFormatter(sep=""))
    axes.xaxis.set_minor_locator(NullLocator())
    axes.spines[["top", "right"]].set_visible(False)
    axes.tick_params(colors=SOFT)
    axes.grid(alpha=0.25)
    xs, ys = ([mark.figures[name] for mark in known] for name in (cost, quality))
    front = pareto_front([x.mean for x in xs], [y.mean for y in ys])
    axes.plot([xs[i].mean for i in front], [ys[i].mean for i in front], color=FRONT, zorder=1)
    for mark, x, y in zip(known, xs, ys, strict=True):
        colour = NAMED if mark.is_named else INK
        axes.errorbar(x.mean, y.mean, _bar(y), _bar(x), fmt="o", ms=5, color=colour, elinewidth=1)
    axes.margins(0.1)


def _name_points(
    axes: "Axes", marks: Sequence[Mark], names: tuple[str, str], points_per_px: float
) -> None:
    """A name beside each point, the named one's first, each where it covers fewest others."""
    cost, quality = names
    taken: list[tuple[float, float, float, float]] = []
    known = [mark for mark in marks if cost in mark.figures and quality in mark.figures]
    for mark in sorted(known, key=lambda mark: not mark.is_named):
        place = mark.figures[cost].mean, mark.figures[quality].mean
        x_px, y_px = axes.transData.transform(place)
        boxes = {
            offset: _name_box(mark.name, x_px * points_per_px, y_px * points_per_px, *offset)
            for offset in NAME_OFFSETS
        }
        best = min(boxes, key=lambda offset: sum(_overlap(boxes[offset], one) for one in taken))
        taken.append(boxes[best])
        across, up, side = best
        axes.annotate(
            mark.name,
            place,
            xytext=(across, up),
            textcoords="offset points",
            ha=side,
            fontsize=NAME_PT,
            color=NAMED if mark.is_named else INK,
        )


def _name_box(
    name: str, x_pt: float, y_pt: float, across_pt: float, up_pt: float, side: str
) -> tuple[float, float, float, float]:
    """About where a name lies: left, bottom, right, top."""
    width_pt = 0.55 * NAME_PT * len(name)
    left = x_pt + across_pt - {"center": 0.5, "left": 0.0, "right": 1.0}[side] * width_pt
    return left, y_pt + up_pt, left + width_pt, y_pt + up_pt + NAME_PT


def _overlap(
    one: tuple[float, float, float, float], other: tuple[float, float, float, float]
) -> float:
    """Area that both boxes cover."""
    width = min(one[2], other[2]) - max(one[0], other[0])
    height = min(one[3], other[3]) - max(one[1], other[1])
    return max(width, 0.0) * max(height, 0.0)


def _bar(spread: Spread) -> float:
    return spread.half_width if math.isfinite(spread.half_width) else 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Line:
    """How a figure changes from level to level."""

    name: str
    levels: Sequence[str]
    values: Sequence[Spread]
    colour: int = 0
    """Lines of one colour belong together."""
    is_dashed: bool = False


def draw_lines(
    panels: Mapping[str, Sequence[Line]], label: str, stem: Path, *, are_gains: bool = False
) -> list[Path]:
    """Draw small multiples, a panel for each title, as SVG and PNG; returns both files.

    All panels share the y axis and its label; where they show gains, with a line at none. `stem`
    has no suffix.

    Raises:
        WriteError: a file cannot be written.
    """
    import matplotlib as mpl
    from matplotlib.figure import Figure

    rows = math.ceil(len(panels) / COLUMNS)
    size = 0.7 * PANEL_INCHES[0] * COLUMNS, 0.7 * PANEL_INCHES[1] * rows
    with mpl.rc_context({"svg.hashsalt": SALT, "font.size": 7.5, "axes.edgecolor": FRONT}):
        figure = Figure(figsize=size, layout="constrained")
        axes = list(figure.subplots(rows, COLUMNS, squeeze=False, sharey=True).flat)
        for panel, (title, lines) in zip(axes, panels.items(), strict=False):
            panel.set_title(title, loc="left", color=INK, fontsize=8)
            panel.spines[["top", "right"]].set_visible(False)
            panel.tick_params(colors=SOFT)
            panel.grid(alpha=0.25)
            if are_gains:
                panel.axhline(0.0, color=FRONT)
            for line in lines:
                panel.errorbar(
                    line.levels,
                    [value.mean for value in line.values],
                    [_bar(value) for value in line.values],
                    fmt="o--" if line.is_dashed else "o-",
                    ms=3,
                    color=COLOURS[line.colour % len(COLOURS)],
                    label=line.name,
                )
        for panel in axes[len(panels) :]:
            panel.axis("off")
        figure.suptitle(label, x=0.01, ha="left", color=INK)
        shown = [axis.get_legend_handles_labels() for axis in axes]
        names = {name: handle for pair in shown for handle, name in zip(*pair, strict=True)}
        figure.legend(names.values(), names, loc="outside upper right", ncols=len(names))
        return _saved(figure, stem)


def write_chart_page(
    chart: Chart, costs: Sequence[str], qualities: Sequence[str], path: Path
) -> Path:
    """One HTML file with all of it, to be looked at without a network: axes are chosen in it.

    Raises:
        WriteError: the file cannot be written.
    """
    from plotly.subplots import make_subplots

    figure = make_subplots(rows=1, cols=len(chart.panels), subplot_titles=list(chart.panels))
    all_marks = [mark for marks in chart.panels.values() for mark in marks]
    for column, marks in enumerate(chart.panels.values(), start=1):
        for mark in marks:
            figure.add_scatter(
                name=mark.name,
                mode="markers+text",
                text=[mark.name],
                textposition="top right",
                marker={"color": NAMED if mark.is_named else INK, "size": 9},
                **_axis("x", mark, costs[0]),
                **_axis("y", mark, qualities[0]),
                row=1,
                col=column,
            )
    menus = [
        _menu("x", costs, all_marks, chart, position=0.0),
        _menu("y", qualities, all_marks, chart, position=0.4),
    ]
    figure.update_xaxes(type="log", title=chart.labels[costs[0]])
    figure.update_yaxes(title=chart.labels[qualities[0]])
    figure.update_layout(
        title=chart.title,
        template="plotly_white",
        showlegend=False,
        updatemenus=menus,
        margin={"t": 140},
    )
    page = figure.to_html(include_plotlyjs=True, full_html=True)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(page, "utf-8")
    except OSError as error:
        raise WriteError(f"{path} cannot be written: {error.strerror}") from None
    return path


def _axis(axis: str, mark: Mark, name: str) -> dict[str, Any]:
    """Place and bar of a mark along an axis; none where its figure is not known."""
    spread = mark.figures.get(name)
    place = [] if spread is None else [spread.mean]
    bar = [] if spread is None else [_bar(spread)]
    return {axis: place, f"error_{axis}": {"type": "data", "array": bar}}


def _menu(
    axis: str, names: Sequence[str], marks: Sequence[Mark], chart: Chart, *, position: float
) -> dict[str, Any]:
    """A menu that puts another figure on an axis of all panels."""
    ends = ["", *map(str, range(2, len(chart.panels) + 1))]
    buttons = []
    for name in names:
        parts = [_axis(axis, mark, name) for mark in marks]
        places = {axis: [part[axis] for part in parts]}
        bars = {f"error_{axis}.array": [part[f"error_{axis}"]["array"] for part in parts]}
        titles = {f"{axis}axis{end}.title.text": chart.labels[name] for end in ends}
        args = [{**places, **bars}, titles]
        buttons.append({"label": chart.labels[name], "method": "update", "args": args})
    return {"buttons": buttons, "x": position, "xanchor": "left", "y": 1.3, "yanchor": "top"}
