"""Index the JSON tables of nuScenes without holding them in memory.

A table is one JSON array of flat rows; the largest of v1.0-trainval have 2.6 million rows and more
than a gigabyte. Each is read through once, row by row. Kept of a row are only its place in the file
and a 64-bit hash of the key it is looked up by, 20 bytes in all. A row asked for is read again from
its place and compared by its whole key, so that equal hashes cannot confuse two rows.

Rows are found by their tokens alone. `prev` and `next` are never followed: a cycle in them has no
effect, and order comes from timestamps.
"""

import hashlib
import json
from array import array
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal

import numpy as np

from lidarpainter_models.errors import DataError
from lidarpainter_models.readers.nuscenes.rows import TableRow, shown

MAX_ROW_BYTES = 1 << 20
"""A longer row is refused; those of nuScenes have a few hundred bytes."""
_CHUNK_BYTES = 1 << 22
_BLANK = " \t\n\r"
_SIDES: tuple[Literal["left", "right"], ...] = ("left", "right")


class NuscenesTable:
    """One table, indexed by one of its columns."""

    def __init__(self, path: Path, key: str = "token") -> None:
        """Read the table through once.

        Raises:
            DataError: the file is missing, or is not an array of rows with that key.
        """
        self.path, self.key = path, key
        hashes, offsets, lengths = array("q"), array("q"), array("i")
        stream = _RowStream(path)
        for row, offset, length in stream:
            value = row.get(key)
            if not isinstance(value, str):
                raise DataError(f"{path}, row {len(hashes)}: {key} is no text but {shown(value)}")
            hashes.append(hash(_as_utf8(value)))
            offsets.append(offset)
            lengths.append(length)
        self.sha256 = stream.sha256
        self._offsets = np.frombuffer(offsets, np.int64)
        self._lengths = np.frombuffer(lengths, np.int32)
        unsorted = np.frombuffer(hashes, np.int64)
        self._order = np.argsort(unsorted, kind="stable").astype(np.uint32)
        self._hashes = unsorted[self._order]

    def __len__(self) -> int:
        return len(self._offsets)

    def rows(self) -> list[TableRow]:
        """All rows in the order of the file, for small tables."""
        return self._read(np.arange(len(self)))

    def rows_with(self, value: str) -> list[TableRow]:
        """The rows whose key has a value, in the order of the file."""
        first, last = (np.searchsorted(self._hashes, hash(value), side) for side in _SIDES)
        found = self._read(np.sort(self._order[first:last]))
        return [row for row in found if row.values.get(self.key) == value]

    def row(self, value: str, asked_by: str) -> TableRow:
        """The one row whose key has a value.

        Raises:
            DataError: there is no such row, or more than one.
        """
        rows = self.rows_with(value)
        if not rows:
            raise DataError(
                f"{asked_by}: refers to {self.key} {shown(value)}, which {self.path} lacks"
            )
        if len(rows) > 1:
            raise DataError(f"{self.path}: {self.key} {shown(value)} stands in {len(rows)} rows")
        return rows[0]

    def _read(self, positions: np.ndarray) -> list[TableRow]:
        if len(positions) == 0:
            return []
        rows = []
        try:
            with self.path.open("rb") as file:
                for position in positions:
                    file.seek(int(self._offsets[position]))
                    content = file.read(int(self._lengths[position]))
                    rows.append(self._table_row(content, int(position)))
        except OSError as error:
            raise DataError(f"{self.path}: cannot be read ({error.strerror})") from None
        return rows

    def _table_row(self, content: bytes, position: int) -> TableRow:
        try:
            values = json.loads(content)
        except (ValueError, RecursionError):
            raise DataError(f"{self.path}, row {position}: not a row in UTF-8") from None
        token = values.get("token", values.get(self.key))
        return TableRow(values, f"{self.path}, token {shown(token)}")


class _RowStream:
    """The rows of a JSON array with their places; holds no more than a chunk and a row.

    Bytes are taken as Latin-1, in which every character is one byte: places in the text are places
    in the file. JSON's own signs are the same there; texts are decoded when a row is read.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._decoder = json.JSONDecoder()
        self._digest = hashlib.sha256()
        self._text, self._base, self._position = "", 0, 0

    @property
    def sha256(self) -> str:
        """Of what was read so far."""
        return self._digest.hexdigest()

    def __iter__(self) -> Iterator[tuple[dict[str, Any], int, int]]:
        try:
            with self._path.open("rb") as self._file:
                self._expect("[")
                if self._next_sign() != "]":
                    yield self._row()
                    while self._next_sign() == ",":
                        self._position += 1
                        yield self._row()
                self._expect("]")
                if self._next_sign():
                    raise self._damage("something follows the array")
        except (FileNotFoundError, NotADirectoryError):
            raise DataError(f"{self._path}: the table is missing") from None
        except OSError as error:
            raise DataError(f"{self._path}: cannot be read ({error.strerror})") from None

    def _row(self) -> tuple[dict[str, Any], int, int]:
        self._next_sign()
        while True:
            try:
                row, end = self._decoder.raw_decode(self._text, self._position)
                break
            except (ValueError, RecursionError):
                if len(self._text) - self._position > MAX_ROW_BYTES or not self._fill():
                    raise self._damage(
                        "not a complete JSON row, expected [{...}, {...}, ...]"
                    ) from None
        if not isinstance(row, dict):
            raise self._damage("an entry of the array is no row, expected [{...}, {...}, ...]")
        start, self._position = self._position, end
        if end - start > MAX_ROW_BYTES:
            raise self._damage(f"a row of more than {MAX_ROW_BYTES} bytes ends")
        return row, self._base + start, end - start

    def _next_sign(self) -> str:
        """The next character that is not blank, without taking it; empty at the end."""
        while True:
            while self._position < len(self._text) and self._text[self._position] in _BLANK:
                self._position += 1
            if self._position < len(self._text):
                return self._text[self._position]
            if not self._fill():
                return ""

    def _expect(self, sign: str) -> None:
        if self._next_sign() != sign:
            raise self._damage(f"expected {sign!r} of an array of rows")
        self._position += 1

    def _fill(self) -> bool:
        """Read on; False at the end of the file."""
        content = self._file.read(_CHUNK_BYTES)
        self._digest.update(content)
        self._base += self._position
        self._text, self._position = self._text[self._position :] + content.decode("latin-1"), 0
        return bool(content)

    def _damage(self, what: str) -> DataError:
        return DataError(f"{self._path}, byte {self._base + self._position}: {what}")


def _as_utf8(text: str) -> str:
    """What a text read as Latin-1 says in UTF-8, in which the file is written."""
    if text.isascii():
        return text
    try:
        return text.encode("latin-1").decode("utf-8")
    except UnicodeError:  # it came from \u escapes, which mean themselves
        return text
