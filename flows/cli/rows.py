"""How rows of the catalog and explanations of results are shown, in tables and as JSON."""

import json
from collections.abc import Iterator
from typing import Any

from flows.cli.output import Cell, format_bytes

JSON_COLUMNS = (
    *("parameters", "stage_seconds", "result", "change"),
    *("inputs", "config", "summary", "record"),
    *("asked", "budget", "effort"),
)
"""Columns that hold JSON text: shown as what they hold."""
LONGEST_JSON = 120
"""Characters of such a column in a table."""


def told_explanation(part: str, found: Any, shown: set[str], depth: int = 0) -> Iterator[str]:  # noqa: ANN401
    """An explanation as indented lines; what was explained above is only named."""
    indent = "  " * depth
    state = f"STALE: {'; '.join(found.stale)}" if found.stale else ""
    again = "see above" if found.name in shown and found.facts else ""
    title = f"{part}: {found.name}" if part else found.name
    yield indent + "  ".join(text for text in (title, state, again) if text)
    if again:
        return
    shown.add(found.name)
    for fact, value in found.facts.items():
        if value:
            yield f"{indent}  {fact}: {_short(value)}"
    for what, value in (found.newest or {}).items():
        yield f"{indent}  newest {what}: {_short(value)}"
    for name, made in found.inputs.items():
        yield from told_explanation("" if name == made.name else name, made, shown, depth + 1)


def _short(value: Any) -> str:  # noqa: ANN401 - any JSON value
    text = value if isinstance(value, str) else json.dumps(value, ensure_ascii=False)
    return f"{text[:LONGEST_JSON]}... (--json shows all)" if len(text) > LONGEST_JSON else text


def opened_row(row: dict[str, Any]) -> dict[str, Any]:
    """A row with times as text and JSON columns as what they hold."""
    from catalog.records import json_of

    opened = {}
    for name, value in row.items():
        if value is not None and name in JSON_COLUMNS:
            value = json_of(row, name)
        opened[name] = value.isoformat() if hasattr(value, "isoformat") else value
    return opened


def row_cell(name: str, value: Any) -> Cell:  # noqa: ANN401 - any value of a table
    """A cell of a table: sizes, times and lists as people read them, long JSON cut off."""
    if value is None or isinstance(value, (bool, float, int)):
        return format_bytes(value) if value is not None and name.endswith("bytes") else value
    if isinstance(value, list):
        return ", ".join(map(str, value))
    if hasattr(value, "isoformat"):
        return value.strftime("%Y-%m-%d %H:%M:%S")  # UTC, as all times of the catalog
    is_long = name in JSON_COLUMNS and len(value) > LONGEST_JSON
    return f"{value[:LONGEST_JSON]}... (--json shows all)" if is_long else str(value)
