"""What commands say: a table or one JSON object on stdout, everything else on stderr."""

import json
import sys
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Literal

from rich.console import Console
from rich.table import Table

from tasks.json_files import finite_or_none

Cell = str | int | float | bool | None
FILE_WIDTH = 200
"""Columns of a table that is not written to a terminal."""
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
    """One JSON object on stdout; numbers that JSON lacks (infinite, not a number) become null."""
    clear_status()
    text = json.dumps(finite_or_none(result), indent=2, allow_nan=False, ensure_ascii=False)
    sys.stdout.write(text + "\n")


def print_table(
    title: str,
    columns: Sequence[str],
    rows: Iterable[Sequence[Cell]],
    note: str = "",
    *,
    num_text_columns: int = 1,
) -> None:
    """A table on stdout; an absent value is a dash, columns after the text ones stand right."""
    clear_status()
    console = Console()
    if not console.is_terminal:
        console = Console(width=FILE_WIDTH)
    table = Table(title=title, title_justify="left", title_style="bold")
    for index, column in enumerate(columns):
        table.add_column(
            column, overflow="fold", justify="left" if index < num_text_columns else "right"
        )
    for row in rows:
        table.add_row(*(format_cell(cell) for cell in row))
    console.print(table)
    if note:
        console.print(note, markup=False, highlight=False)


def print_pairs(title: str, pairs: Mapping[str, Cell], note: str = "") -> None:
    """A table of two columns: what, and its value."""
    print_table(title, ["what", "value"], list(pairs.items()), note, num_text_columns=2)


def complain(message: str) -> None:
    """One line on stderr."""
    clear_status()
    line = " ".join(message.split())
    sys.stderr.write(f"lidarpainter: {line}\n")


def format_cell(value: Cell) -> str:
    """Print a value: floats with three decimals, absent ones as a dash."""
    if value is None:
        return "-"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.3f}"
    return str(value).replace("[", "\\[")  # rich would read brackets as its markup


def format_bytes(num_bytes: float) -> str:
    """A size for people: 12.3 MB."""
    for unit in ("B", "kB", "MB", "GB"):
        if num_bytes < 1000:
            return f"{num_bytes:.0f} {unit}" if unit == "B" else f"{num_bytes:.1f} {unit}"
        num_bytes /= 1000
    return f"{num_bytes:.1f} TB"
