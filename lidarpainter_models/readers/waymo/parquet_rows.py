"""Rows of Parquet files as downloaded: small tables whole, large ones streamed frame by frame.

Every column that is asked for must be there and every value is checked when it is taken, with the
file, row and column in the error. Nothing is unpacked before the pages have said how much it is.
"""

import hashlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from lidarpainter_models.errors import DataError
from lidarpainter_models.readers.source_logs.parquet_pages import unpacked_bytes

MAX_SMALL_ROWS = 200_000
MAX_ROWS = 1_000_000
MAX_SMALL_BYTES = 256 << 20
MAX_ROW_BYTES = 64 << 20
"""Of one row when unpacked, on the average of its row group; a range image takes 4 MB."""
MAX_ROWS_PER_FRAME = 64
"""No component that is streamed has more than eight sensors."""
MAX_TEXT_BYTES = 256
"""Of one text; the name of a segment has 50."""
_BATCH_ROWS = 2
_BUFFER_BYTES = 1 << 20
"""Read from a column at a time, so that a row group is never in memory whole."""


@dataclass(frozen=True, eq=False)
class ParquetRow:
    """One row and its place."""

    values: dict[str, Any]
    """Python values, Arrow scalars for lists."""
    place: str

    def number(self, column: str) -> float:
        """A number; a truth value is none."""
        return float(self._value(column, (int, float), "a number"))

    def whole_number(self, column: str) -> int:
        """A whole number."""
        return self._value(column, (int,), "a whole number")

    def text(self, column: str) -> str:
        """A text."""
        return self._value(column, (str,), "a text")

    def content(self, column: str) -> bytes:
        """A file's bytes."""
        return self._value(column, (bytes,), "bytes")

    def numbers(self, column: str) -> np.ndarray:
        """A list of numbers; empty where the list is absent."""
        value = self.values[column]
        if value is None:
            return np.empty(0)
        if not isinstance(value, pa.Array) or not (
            pa.types.is_floating(value.type) or pa.types.is_integer(value.type)
        ):
            raise DataError(f"{self.place}, {column}: expected a list of numbers")
        if value.null_count:
            raise DataError(f"{self.place}, {column}: a number of the list is absent")
        return value.to_numpy(zero_copy_only=False)

    def _value(self, column: str, kinds: tuple[type, ...], expected: str) -> Any:  # noqa: ANN401
        value = self.values[column]
        if value is None:
            raise DataError(f"{self.place}, {column}: is empty")
        if isinstance(value, bool) or not isinstance(value, kinds):
            raise DataError(f"{self.place}, {column}: {value!r:.60}, expected {expected}")
        return value


class ParquetRows:
    """The rows of one file, of which some columns are read."""

    def __init__(
        self, path: Path, columns: tuple[str, ...], optional: tuple[str, ...] = ()
    ) -> None:
        """Open the file and check that it has the columns; optional ones are None without.

        Raises:
            DataError: the file is missing, damaged, or lacks a column.
        """
        self.path = Path(path)
        self._digest = hashlib.sha256()
        if not self.path.is_file():
            raise DataError(f"{self.path}: the file is missing")
        try:
            footer = pq.read_metadata(self.path)
            self._types = {field.name: field.type for field in footer.schema.to_arrow_schema()}
            self._file = pq.ParquetFile(
                self.path,
                metadata=footer,
                # as a dictionary, a text that all rows repeat is unpacked once
                read_dictionary=[name for name, kind in self._types.items() if _is_text(kind)],
                buffer_size=_BUFFER_BYTES,
                page_checksum_verification=True,
            )
        except (pa.ArrowException, OSError, ValueError) as error:
            raise self._damaged(error) from None
        missing = [column for column in columns if column not in self._types]
        if missing:
            raise DataError(f"{self.path}: no column {', '.join(missing)}")
        self._columns = [*columns, *(name for name in optional if name in self._types)]
        self._absent = dict.fromkeys(name for name in optional if name not in self._types)

    @property
    def num_rows(self) -> int:
        """How many rows the file states."""
        return self._file.metadata.num_rows

    def small_table(self) -> list[ParquetRow]:
        """All rows at once.

        Raises:
            DataError: there are more than a small table has, files among them, or they cannot be
                read.
        """
        self._require_kinds(_is_small, "numbers or texts")
        num_bytes = sum(self._unpacked_bytes())
        if self.num_rows > MAX_SMALL_ROWS or num_bytes > MAX_SMALL_BYTES:
            raise DataError(
                f"{self.path}: {self.num_rows} rows of {num_bytes} bytes, expected at most "
                f"{MAX_SMALL_ROWS} rows and {MAX_SMALL_BYTES} bytes"
            )
        with self.path.open("rb") as file:
            self._digest = hashlib.file_digest(file, "sha256")
        return list(self._rows(batch_rows=1024))

    def stream(self) -> Iterator[ParquetRow]:
        """Row by row; no more than a few are in memory.

        Raises:
            DataError: the file states too many or too large rows, lists of files among them, or
                they cannot be read.
        """
        self._require_kinds(
            lambda kind: _is_small(kind) or pa.types.is_binary(kind), "numbers, texts or files"
        )
        metadata = self._file.metadata
        if self.num_rows > MAX_ROWS:
            raise DataError(f"{self.path}: {self.num_rows} rows, expected {MAX_ROWS} at most")
        for number, num_bytes in enumerate(self._unpacked_bytes()):
            num_rows = metadata.row_group(number).num_rows
            if num_bytes > MAX_ROW_BYTES * max(num_rows, 1):
                raise DataError(
                    f"{self.path}, row group {number}: {num_rows} rows of "
                    f"{num_bytes} bytes, expected {MAX_ROW_BYTES} a row at most"
                )
        yield from self._rows(batch_rows=_BATCH_ROWS)

    def take_digest(self, content: bytes | memoryview) -> None:
        """Note what was used of a row."""
        self._digest.update(content)

    def provenance(self) -> dict[str, object]:
        """How much there is, and one digest over what was used."""
        return {"num_rows": self.num_rows, "sha256": self._digest.hexdigest()}

    def _require_kinds(self, is_known: Callable[[pa.DataType], bool], expected: str) -> None:
        for name in self._columns:
            kind = self._types[name]
            if not is_known(kind):
                raise DataError(f"{self.path}: column {name} is {kind}, expected {expected}")

    def _unpacked_bytes(self) -> list[int]:
        try:
            return unpacked_bytes(self.path, self._file.metadata)
        except (OSError, ValueError) as error:
            raise self._damaged(error) from None

    def _rows(self, *, batch_rows: int) -> Iterator[ParquetRow]:
        number = 0
        batches = self._file.iter_batches(
            batch_size=batch_rows, columns=self._columns, use_threads=False
        )
        while True:
            try:
                batch = next(batches, None)
                rows = [] if batch is None else _values(batch)
            except (pa.ArrowException, OSError, ValueError, KeyError, OverflowError) as error:
                raise self._damaged(error) from None
            if batch is None:
                return
            for values in rows:
                yield ParquetRow({**values, **self._absent}, f"{self.path}, row {number}")
                number += 1

    def _damaged(self, error: Exception) -> DataError:
        reason = " ".join(str(error).split())[:200] or type(error).__name__
        return DataError(f"{self.path}: cannot be read as Parquet ({reason})")


class FrameStream:
    """The rows of a large file that is in the order of time, frame by frame."""

    def __init__(self, rows: ParquetRows, time_column: str) -> None:
        self._rows = rows.stream()
        self._time_column = time_column
        self._ahead: ParquetRow | None = None
        self._last_us = -1

    def rows_at(self, time_us: int) -> list[ParquetRow]:
        """The rows of one frame; frames are asked for in ascending order.

        Raises:
            DataError: the rows are not in the order of time, or too many for a frame.
        """
        found = []
        row = self._ahead or next(self._rows, None)
        while row is not None:
            row_us = row.whole_number(self._time_column)
            if row_us < self._last_us:
                raise DataError(f"{row.place}, {self._time_column}: not in the order of time")
            self._last_us = row_us
            if row_us > time_us:
                break
            if row_us == time_us:
                found.append(row)
            if len(found) > MAX_ROWS_PER_FRAME:
                raise DataError(
                    f"{row.place}: one row too many, expected {MAX_ROWS_PER_FRAME} a frame at most"
                )
            row = next(self._rows, None)
        self._ahead = row
        return found


def _is_text(kind: pa.DataType) -> bool:
    return bool(pa.types.is_string(kind) or pa.types.is_large_string(kind))


def _is_list(kind: pa.DataType) -> bool:
    return bool(pa.types.is_list(kind) or pa.types.is_fixed_size_list(kind))


def _is_small(kind: pa.DataType) -> bool:
    """Whether values take no more than pages say: numbers, lists of them, and texts."""
    number = kind.value_type if _is_list(kind) else kind
    return bool(_is_text(kind) or pa.types.is_primitive(number) or pa.types.is_null(number))


def _require_short(column: pa.DictionaryArray, name: str) -> None:
    longest = pc.max(pc.binary_length(column.dictionary)).as_py() or 0
    if longest > MAX_TEXT_BYTES:
        raise DataError(f"{name}: a text of {longest} bytes, expected {MAX_TEXT_BYTES} at most")


def _values(batch: pa.RecordBatch) -> list[dict[str, Any]]:
    """The rows of a batch; lists stay Arrow arrays, a range image would take seconds as a list."""
    columns = {}
    for name, column in zip(batch.schema.names, batch.columns, strict=True):
        if pa.types.is_dictionary(column.type):
            _require_short(column, name)
        is_list = _is_list(column.type)
        columns[name] = [scalar.values for scalar in column] if is_list else column.to_pylist()
    return [
        dict(zip(columns, values, strict=True)) for values in zip(*columns.values(), strict=True)
    ]
