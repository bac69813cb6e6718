"""What commands say: a table or one JSON object on stdout, everything else on stderr."""

import json
import sys
from collections.abc import Iterable, Mapping, Sequence
from shutil import get_terminal_size
from typing import Any, Literal, TypeGuard

from flows.cli.tables import ABSENT, Side, heading_of, pair_lines, table_lines
from tasks.json_files import finite_or_none

Cell = str | int | float | bool | None
PLAIN_WIDTH = 80
"""Columns of what is not written to a terminal."""
JSON_WIDTH = 100
"""Columns of a line of JSON, if it can be broken."""
CLEAR_LINE = "\r\x1b[K"

Loudness = Literal["quiet", "usual", "verbose"]

_loudness: list[Loudness] = ["usual"]
_status: list[str] = []
"""What a terminal shows until something takes its place."""


def set_loudness(chosen: Loudness) -> None:
    """Choose how much is said on stderr while a command runs; errors always are."""
    _loudness[0] = chosen


def loudness() -> Loudness:
    """What `set_loudness` chose last."""
    return _loudness[0]


def say_status(text: str) -> None:
    """Say on a terminal what is being done, before anything slow is imported for it."""
    if sys.stderr.isatty() and loudness() != "quiet":
        _status.append(text)
        sys.stderr.write(f"{CLEAR_LINE}{text} ...")
        sys.stderr.flush()


def clear_status() -> None:
    """Take back what `say_status` has said."""
    if _status:
        _status.clear()
        sys.stderr.write(CLEAR_LINE)
        sys.stderr.flush()


def print_json(result: Mapping[str, Any]) -> None:
    """Print one JSON object on stdout, on few lines: what has room on one is not broken.

    Numbers that JSON lacks (infinite, not a number) become null.
    """
    clear_status()
    sys.stdout.write(_json_text(finite_or_none(result), 0) + "\n")


def _json_text(value: Any, indent: int, before: int = 0) -> str:  # noqa: ANN401 - any JSON value
    """A JSON value, broken into lines where it has no room behind what stands `before` it."""
    text = _on_one_line(value)
    is_short = indent + before + len(text) < JSON_WIDTH
    if is_short or not isinstance(value, dict | list) or not value:
        return text
    opening, closing = "{}" if isinstance(value, dict) else "[]"
    if isinstance(value, dict):
        names = [(f"{_on_one_line(name)}: ", one) for name, one in value.items()]
    else:
        names = [("", part) for part in value]
    pad = " " * (indent + 2)
    lines = [f"{pad}{name}{_json_text(part, indent + 2, len(name))}" for name, part in names]
    return "\n".join([opening, ",\n".join(lines), " " * indent + closing])


def _on_one_line(value: Any) -> str:  # noqa: ANN401 - any JSON value
    """JSON with letters beyond ASCII escaped where stdout cannot show them."""
    is_utf8 = (getattr(sys.stdout, "encoding", None) or "utf-8").lower() == "utf-8"
    return json.dumps(value, allow_nan=False, ensure_ascii=not is_utf8)


def print_table(
    title: str,
    columns: Sequence[str],
    rows: Iterable[Sequence[Cell]],
    note: str = "",
    *,
    num_text_columns: int = 1,
) -> None:
    """Print a table on stdout that fits its terminal, or 80 columns where that is none.

    Columns where no row has a value are left out, and text wraps between words. A table that is too
    wide even then is printed row by row, a line for each value.

    Args:
        title: what stands above.
        columns: headings, or names of fields that `tables.HEADINGS` says in words.
        rows: cells, as many as columns; None is an absent value, shown as a dash.
        note: lines below the table.
        num_text_columns: how many of the first columns stand left; the others stand right.
    """
    clear_status()
    cells = [[format_cell(cell) for cell in row] for row in rows]
    kept = [i for i in range(len(columns)) if not cells or any(row[i] != ABSENT for row in cells)]
    headings = [heading_of(columns[i]) for i in kept]
    body = [[row[i] for i in kept] for row in cells]
    sides: list[Side] = ["left" if i < num_text_columns else "right" for i in kept]
    for line in table_lines(title, headings, body, sides, width=_width()):
        sys.stdout.write(line + "\n")
    if note:
        sys.stdout.write(note + "\n")


def print_pairs(title: str, pairs: Mapping[str, Cell], note: str = "") -> None:
    """Print what is known of one thing, a line for each value; absent values are left out."""
    clear_status()
    shown = {
        heading_of(name): format_bytes(value) if _is_size(value, name) else format_cell(value)
        for name, value in pairs.items()
        if value is not None
    }
    sys.stdout.write("\n".join([title, *pair_lines(shown, width=_width())]) + "\n")
    if note:
        sys.stdout.write(note + "\n")


def print_result(title: str, result: Mapping[str, Any], *, as_json: bool) -> None:
    """Print what a command made: as one JSON object, or in rows below a title."""
    if as_json:
        print_json(result)
    else:
        print_pairs(title, result)


def _width() -> int:
    """Columns of the terminal, or as many as every terminal has."""
    return get_terminal_size((PLAIN_WIDTH, 24)).columns if sys.stdout.isatty() else PLAIN_WIDTH


def _is_size(value: Cell, name: str) -> TypeGuard[int | float]:
    return name.endswith("bytes") and isinstance(value, int | float)


def complain(message: str) -> None:
    """One line on stderr that says what is wrong."""
    clear_status()
    line = " ".join(message.split())
    sys.stderr.write(f"lidarpainter: {line}\n")


def tell(line: str) -> None:
    """One line on stderr about what happens, unless silence is asked for; no error begins so."""
    if loudness() != "quiet":
        clear_status()
        sys.stderr.write(f"{' '.join(line.split())}\n")


def format_cell(value: Cell) -> str:
    """A value as text: floats with three decimals, an absent one as a dash."""
    if value is None or value == "":
        return ABSENT
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.3f}"
    return str(value)


def format_bytes(num_bytes: float) -> str:
    """A size for people: 12.3 MB."""
    for unit in ("B", "kB", "MB", "GB"):
        if num_bytes < 1000:
            return f"{num_bytes:.0f} {unit}" if unit == "B" else f"{num_bytes:.1f} {unit}"
        num_bytes /= 1000
    return f"{num_bytes:.1f} TB"
