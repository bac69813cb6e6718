"""Read the files of a downloaded log and remember what was read, for provenance."""

import hashlib
import json
import os
import stat
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from lidarpainter_models.errors import DataError

MAX_FILE_BYTES = 256 * 1024 * 1024
"""A file that is read whole may be no larger; the largest of PandaSet has 4 MB."""
_JSON_KINDS: dict[type, str] = {dict: "object", list: "list"}


class SourceFolder:
    """A folder of a dataset as downloaded."""

    def __init__(self, root: Path) -> None:
        self.root = Path(root)
        self._digests: dict[str, str] = {}

    def read_bytes(self, name: str) -> bytes:
        """The content of one file.

        Raises:
            DataError: the file is missing, too large, or cannot be read.
        """
        path = self.root / name
        try:
            content = _content(path)
        except (FileNotFoundError, NotADirectoryError):
            raise DataError(f"{path}: the file is missing") from None
        except OSError as error:
            raise DataError(f"{path}: cannot be read ({error.strerror})") from None
        self._digests[name] = hashlib.sha256(content).hexdigest()
        return content

    def read_points(self, name: str, num_columns: int) -> Float[np.ndarray, "points columns"]:
        """Rows of float32 numbers, little-endian, as LiDAR points are often stored.

        Raises:
            DataError: the file cannot be read, is cut off, or a number is not finite.
        """
        path, content, point_bytes = self.root / name, self.read_bytes(name), 4 * num_columns
        if len(content) % point_bytes:
            expected = f"expected whole points of {point_bytes} bytes"
            raise DataError(f"{path}: {len(content)} bytes, {expected}")
        rows = np.frombuffer(content, "<f4").reshape(-1, num_columns)
        if not np.isfinite(rows).all():
            number = int(np.flatnonzero(~np.isfinite(rows).all(axis=1))[0])
            raise DataError(f"{path}, point {number}: holds something other than finite numbers")
        return rows

    def read_json(self, name: str, kind: type) -> Any:  # noqa: ANN401
        """A JSON file whose outermost value is a list or a dict."""
        try:
            value = json.loads(self.read_bytes(name))
        except (ValueError, RecursionError) as error:
            if isinstance(error, DataError):
                raise
            what = f"expected a JSON {_JSON_KINDS[kind]}, cannot be read ({error})"
            raise DataError(f"{self.root / name}: {what}") from None
        if not isinstance(value, kind):
            found = _JSON_KINDS.get(type(value), type(value).__name__)
            raise DataError(f"{self.root / name}: holds JSON {found}, expected {_JSON_KINDS[kind]}")
        return value

    def provenance(self) -> dict[str, object]:
        """How many files were read, and one digest over their names and contents."""
        content = json.dumps(sorted(self._digests.items()))
        return {
            "num_files": len(self._digests),
            "sha256": hashlib.sha256(content.encode()).hexdigest(),
        }


def _content(path: Path) -> bytes:
    """All of a regular file; a pipe or a device would never end."""
    descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
    with os.fdopen(descriptor, "rb") as file:
        status = os.fstat(descriptor)
        if not stat.S_ISREG(status.st_mode):
            raise DataError(f"{path}: not a file")
        if status.st_size > MAX_FILE_BYTES:
            raise DataError(f"{path}: {status.st_size} bytes, expected at most {MAX_FILE_BYTES}")
        return file.read()
