"""One self-contained HTML page about a run: images beside the truth, curves, tables, facts.

Nothing is loaded from elsewhere: styles, script and images stand in the page. Every text is
escaped by the template, since names come from datasets.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib.resources import files
from itertools import cycle

import jinja2

from lidarpainter_models.export.images import jpeg_data_url
from lidarpainter_models.export.pictures import Comparison, MovingPicture, WorstView

PLOT_WIDTH, PLOT_HEIGHT = 460, 240
PLOT_MARGIN = 46
MOST_SHOWN_FACTS = 20
SERIES_COLOURS = (
    *("#0b6e99", "#d1495b", "#5c8001", "#8f5db7"),
    *("#c77700", "#555555", "#009e8e", "#7a4b2a"),
)

Cell = str | float | int | None


@dataclass(frozen=True, kw_only=True)
class Table:
    """Rows under column heads; a None cell prints as a dash."""

    title: str
    columns: Sequence[str]
    rows: Sequence[Sequence[Cell]]
    note: str = ""


@dataclass(frozen=True, kw_only=True)
class Plot:
    """Lines over a common axis."""

    title: str
    x_label: str
    y_label: str
    series: Mapping[str, Sequence[tuple[float, float]]]


@dataclass(frozen=True, kw_only=True)
class Report:
    """Everything the page shows, in order."""

    title: str
    summary: Sequence[str]
    """Paragraphs below the title."""
    verdict: Sequence[str] = ()
    """What is good and what is bad, in sentences."""
    moving: MovingPicture | None = None
    """The first thing to be seen."""
    worst: Sequence[WorstView] = ()
    worst_title: str = "Worst views"
    repeat: Sequence[str] = ()
    """Commands that make the run again and show more of it."""
    comparisons: Sequence[Comparison] = ()
    tables: Sequence[Table] = ()
    plots: Sequence[Plot] = ()
    facts: Mapping[str, Mapping[str, str]] = field(default_factory=dict)
    """Names and values under a title; long ones are folded up."""


def format_cell(value: Cell) -> str:
    """Print a cell: numbers with three decimals at most, None as a dash."""
    if value is None:
        return "-"
    if isinstance(value, float):
        return f"{value:.3f}" if abs(value) < 100 else f"{value:.1f}"
    return str(value)


def plot_geometry(plot: Plot) -> dict[str, object]:
    """Screen coordinates of a plot's lines and axis marks."""
    points = [point for line in plot.series.values() for point in line]
    xs = [point[0] for point in points] or [0.0]
    ys = [point[1] for point in points] or [0.0]
    low_x, high_x, low_y, high_y = min(xs), max(xs), min(ys), max(ys)
    colours = cycle(SERIES_COLOURS)
    span_x, span_y = (high_x - low_x) or 1.0, (high_y - low_y) or 1.0

    def place(x: float, y: float) -> str:
        across = PLOT_MARGIN + (x - low_x) / span_x * (PLOT_WIDTH - PLOT_MARGIN - 10)
        down = PLOT_HEIGHT - PLOT_MARGIN - (y - low_y) / span_y * (PLOT_HEIGHT - PLOT_MARGIN - 10)
        return f"{across:.1f},{down:.1f}"

    return {
        "title": plot.title,
        "x_label": plot.x_label,
        "y_label": plot.y_label,
        "x_range": (_mark(low_x), _mark(high_x)),
        "y_range": (_mark(low_y), _mark(high_y)),
        "lines": [
            {"label": label, "colour": colour, "points": " ".join(place(*p) for p in line)}
            for (label, line), colour in zip(plot.series.items(), colours, strict=False)
        ],
        "width": PLOT_WIDTH,
        "height": PLOT_HEIGHT,
        "margin": PLOT_MARGIN,
    }


def _mark(value: float) -> str:
    return format_cell(int(value) if float(value).is_integer() else value)


def render_report(report: Report) -> str:
    """The page as one HTML string."""
    source = files("lidarpainter_models.export").joinpath("report.html.j2").read_text("utf-8")
    environment = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined)
    environment.filters |= {"jpeg": jpeg_data_url, "cell": format_cell}
    return environment.from_string(source).render(
        report=report,
        plots=[plot_geometry(plot) for plot in report.plots],
        most_shown_facts=MOST_SHOWN_FACTS,
    )
