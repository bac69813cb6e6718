"""Tables of README and docs out of a record of figures, and the pages that show them.

The record holds every figure that a table shows, with the run it is of; a page shows a table
between two comments. Nothing here knows a store, so that pages can be held to the record anywhere.
"""

import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import fmean
from typing import Any

from flows.measure.figure_manifest import Cell, FigureManifest, Table, cells_of
from flows.measure.figures import written
from lidarpainter_models.errors import ConfigError

Figures = Mapping[str, Any]
"""What a record holds of one table: by the name of a point its run and its figures."""

MARK = re.compile(r"^<!-- figures:", re.MULTILINE)
MARKED = re.compile(r"^<!-- figures: (\S+) -->\n(.*?)^<!-- /figures -->$", re.DOTALL | re.MULTILINE)


class MissingFigureError(ConfigError):
    """A record does not hold what a table shows."""


def rendered(manifest: FigureManifest, table: Table, record: Figures) -> str:
    """A table in Markdown, and below it when, by which code and on which processor.

    Raises:
        MissingFigureError: the record lacks a figure.
    """
    cells = cells_of(manifest, table)
    columns = [column.label for column in table.column]
    lines = [[table.corner, *columns], ["---"] * (1 + len(columns))]
    for i, row in enumerate(table.row):
        shown = [_shown(cells.get((i, j)), record) for j in range(len(columns))]
        lines.append([row.label, *shown])
    used = dict.fromkeys(name for cell in cells.values() for name in cell.points)
    head, rule, *rest = ("| " + " | ".join(line) + " |" for line in lines)
    body = [head, rule.replace(" ", ""), *rest, "", _taken([record[name] for name in used])]
    return "\n".join(body)


def _shown(cell: Cell | None, record: Figures) -> str:
    if cell is None:
        return ""
    texts = []
    for figure, key in zip(cell.figures, cell.keys, strict=True):
        values = [_value(record, name, key, cell) for name in cell.points]
        texts.append(written(figure, fmean(values)))
    return " / ".join(texts)


def _value(record: Figures, name: str, key: str, cell: Cell) -> float:
    try:
        return float(record[name]["figures"][key])
    except KeyError:
        raise MissingFigureError(f"table {cell.table}: no figure {key!r} of {name}") from None


def _taken(points: Sequence[Mapping[str, Any]]) -> str:
    """When the runs were made, by which code, and on what."""

    def distinct(name: str) -> str:
        return ", ".join(sorted({str(one[name]) for one in points}))

    threads = distinct("threads")
    many = "thread" if threads == "1" else "threads"
    code = f"lidarpainter {distinct('version')}, code {distinct('code')}"
    return f"*{distinct('date')}, {code}, {threads} {many} of {distinct('cpu')}.*"


def marked_tables(text: str, page: str) -> dict[str, str]:
    """What stands between the comments of a page, by the name of the table.

    Raises:
        ConfigError: a comment has no other end, or a table stands there twice.
    """
    found = MARKED.findall(text)
    names = [name for name, _ in found]
    if len(MARK.findall(text)) != len(found) or len(set(names)) < len(names):
        raise ConfigError(
            f"{page}: expected for a table one line <!-- figures: NAME --> and, below it, one "
            "<!-- /figures -->"
        )
    return {name: body.strip() for name, body in found}


def with_tables(text: str, tables: Mapping[str, str]) -> str:
    """A page with these tables between their comments; the others stay."""

    def replaced(match: re.Match[str]) -> str:
        name = match[1]
        if name not in tables:
            return match[0]
        return f"<!-- figures: {name} -->\n\n{tables[name]}\n\n<!-- /figures -->"

    return MARKED.sub(replaced, text)


def read_pages(manifest: FigureManifest, folder: Path) -> dict[Path, str]:
    """The pages of a manifest that lies in a folder; every table stands on one of them.

    Raises:
        ConfigError: a page is not there, names a table that is none, or a table stands nowhere.
    """
    pages, places = {}, []
    for name in manifest.pages:
        path = folder / name
        try:
            pages[path] = path.read_text("utf-8")
        except OSError as error:
            raise ConfigError(f"no page {path}: {error.strerror}") from None
        places += list(marked_tables(pages[path], name))
    wanted = [table.name for table in manifest.table]
    if sorted(places) != sorted(wanted):
        odd = sorted({*places} ^ {*wanted}) or [name for name in wanted if places.count(name) > 1]
        raise ConfigError(
            f"tables without a place between comments of a page, or comments without a table, "
            f"or twice: {', '.join(odd)}"
        )
    return pages


def read_record(path: Path) -> dict[str, Figures]:
    """The record, by table; empty where there is none yet.

    Raises:
        ConfigError: it is no record.
    """
    if not path.exists():
        return {}
    try:
        found = json.loads(path.read_text("utf-8"))
        return {str(name): dict(points) for name, points in found.items()}
    except (OSError, ValueError, AttributeError, TypeError):
        raise ConfigError(
            f"{path}: expected a record of figures; without it one is begun"
        ) from None


def record_text(record: Mapping[str, Figures]) -> str:
    """A record as it is written: one figure a line, in order, so that changes are seen."""
    return json.dumps(record, indent=1, sort_keys=True) + "\n"
