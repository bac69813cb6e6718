"""JSON files and what goes into them: numbers that JSON lacks become null."""

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any


def finite_or_none(value: Any) -> Any:  # noqa: ANN401 - any JSON-like value
    """The same value with infinite and not-a-number floats as None: JSON has neither."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {str(key): finite_or_none(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [finite_or_none(item) for item in value]
    return value


def write_json(path: Path, value: Any) -> None:  # noqa: ANN401 - any JSON value
    """Write a JSON file; numbers that JSON lacks become null."""
    text = json.dumps(finite_or_none(value), indent=1, sort_keys=True, allow_nan=False)
    path.write_text(text + "\n", "utf-8")


def read_json(path: Path) -> Any:  # noqa: ANN401 - any JSON value
    """Read a JSON file."""
    return json.loads(path.read_text("utf-8"))
