"""One measured figure, and how a list of them is kept, compared and shown."""

import json
from dataclasses import asdict, dataclass, field

from rich.table import Table

DEFAULT_TOLERANCE = 0.35
"""Relative change of a ratio that a shared machine brings about by itself."""


@dataclass(frozen=True, kw_only=True)
class Figure:
    """A figure as `benchmarks.json` lists it; direction and tolerance are for the comparison."""

    name: str
    value: float
    unit: str
    floor: float | None = None
    """What the machine could reach at best, in the same unit."""
    threads: int = 1
    backend: str = "cpu"
    better: str = field(default="lower")
    tolerance: float = DEFAULT_TOLERANCE
    limit: float | None = None
    """What the ratio (or the value, where there is no floor) is meant to keep to."""

    @property
    def ratio(self):
        """Value over floor; None without a floor."""
        return self.value / self.floor if self.floor else None

    @property
    def judged(self):
        """The number that lasts on other machines."""
        return self.value if self.ratio is None else self.ratio

    def record(self):
        """The entry of `benchmarks.json`."""
        kept = asdict(self)
        names = ("name", "value", "unit", "floor", "ratio", "threads", "backend")
        return {name: self.ratio if name == "ratio" else kept[name] for name in names}


def lasts(figure):
    """Whether a figure says something on another machine: bare times and peaks do not."""
    return figure.ratio is not None or figure.unit == "x"


def compared(figure, baseline):
    """`-` without a baseline, else whether the figure kept to it."""
    old = baseline.get(figure.name)
    if old is None or not lasts(figure):
        return "-"
    change = figure.judged / old - 1.0
    worse = change if figure.better == "lower" else -change
    verdict = "worse" if worse > figure.tolerance else "ok"
    return f"{verdict} ({old:.3g})"


def kept_to(figure):
    """Whether a figure keeps to its limit; `-` where it has none."""
    if figure.limit is None:
        return "-"
    is_kept = (
        figure.judged <= figure.limit if figure.better == "lower" else figure.judged >= figure.limit
    )
    sign = "<=" if figure.better == "lower" else ">="
    return f"{'met' if is_kept else 'MISSED'} ({sign} {figure.limit:g})"


def table(figures, baseline, title):
    """All figures, a row each."""
    shown = Table(
        "name", "value", "unit", "floor", "ratio", "better", "limit", "baseline", title=title
    )
    for figure in figures:
        numbers = (figure.value, figure.floor, figure.ratio)
        value, floor, ratio = ("-" if n is None else f"{n:.4g}" for n in numbers)
        shown.add_row(
            figure.name,
            value,
            figure.unit,
            floor,
            ratio,
            figure.better,
            kept_to(figure),
            compared(figure, baseline),
        )
    return shown


def write_figures(path, figures):
    """The list that other tools read."""
    path.write_text(json.dumps([f.record() for f in figures], indent=2) + "\n", "utf-8")


def baseline_of(figures):
    """What later runs are compared with: only what lasts on other machines."""
    return {f.name: round(f.judged, 3) for f in figures if lasts(f)}
