"""Append rows to the arrays of a scene, chunk by chunk, and take their digest on the way.

Rows are held back until a chunk is full, so a chunk is written once and never read again, and no
more than two chunks of each array are in memory: one that fills up and one that is compressed and
written by the one thread that writes. One writer per array: two would lose data silently.
"""

import hashlib
from collections.abc import Sequence
from concurrent.futures import Executor, Future
from pathlib import Path

import numpy as np
import zarr
from zarr.codecs import Crc32cCodec, ZstdCodec

from lidarpainter_models.errors import DataError
from lidarpainter_models.scenes.schema import ArrayLayout

_ZSTD_LEVEL = 1


class ArrayAppender:
    """One growing array."""

    def __init__(self, group: zarr.Group, layout: ArrayLayout, writing: Executor) -> None:
        self.layout = layout
        self.num_rows = 0
        """Rows handed to the thread that writes."""
        self._writing = writing
        self._last_write: Future[None] | None = None
        self._digest = hashlib.sha256()
        self._pending: list[np.ndarray] = []
        self._num_pending = 0
        # zstd alone would read a flipped bit without complaint
        self._array = group.create_array(
            layout.name,
            shape=(0, *layout.row_shape),
            chunks=(layout.chunk_rows, *layout.row_shape),
            dtype=layout.dtype,
            compressors=[ZstdCodec(level=_ZSTD_LEVEL), Crc32cCodec()],
            fill_value=0,
            attributes={"unit": layout.unit, "description": layout.description},
            # a chunk that is not there must always mean damage
            config={"write_empty_chunks": True},
        )

    def append(self, rows: np.ndarray) -> int:
        """Take rows and give the position of the first one."""
        if rows.shape[1:] != self.layout.row_shape:
            raise DataError(
                f"array {self.layout.name} takes rows of shape {self.layout.row_shape}, "
                f"got {rows.shape[1:]}"
            )
        rows = np.ascontiguousarray(rows, dtype=self.layout.dtype)
        offset = self.num_rows + self._num_pending
        self._digest.update(rows.tobytes())
        self._pending.append(rows)
        self._num_pending += len(rows)
        if self._num_pending >= self.layout.chunk_rows:
            self._flush(self._num_pending - self._num_pending % self.layout.chunk_rows)
        return offset

    def finish(self) -> dict[str, object]:
        """Write what is left; gives the array's entry in the manifest."""
        if self._num_pending:
            self._flush(self._num_pending)
        self._settle()
        return {
            "dtype": self.layout.dtype.name,
            "shape": [self.num_rows, *self.layout.row_shape],
            "sha256": self._digest.hexdigest(),
        }

    def _flush(self, num_rows: int) -> None:
        """Hand rows to the thread that writes, once it is done with the last ones."""
        rows = np.concatenate(self._pending)
        self._settle()
        self._last_write = self._writing.submit(self._write, self.num_rows, rows[:num_rows])
        self.num_rows += num_rows
        self._pending = [rows[num_rows:].copy()]
        self._num_pending = len(rows) - num_rows

    def _settle(self) -> None:
        """Wait for the last write; an error in it is raised here."""
        if self._last_write is not None:
            last, self._last_write = self._last_write, None
            last.result()

    def _write(self, start: int, rows: np.ndarray) -> None:
        end = start + len(rows)
        self._array.resize((end, *self.layout.row_shape))
        self._array[start:end] = rows


def create_arrays(
    folder: Path, layouts: Sequence[ArrayLayout], writing: Executor
) -> dict[str, ArrayAppender]:
    """A new Zarr group with one empty array per layout; `writing` has one thread."""
    group = zarr.create_group(folder, zarr_format=3)
    return {layout.name: ArrayAppender(group, layout, writing) for layout in layouts}
