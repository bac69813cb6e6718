"""The pickled pandas tables of a PandaSet folder, column by column; nothing of them is run."""

import numpy as np

from lidarpainter_models.errors import DataError
from lidarpainter_models.readers.pandaset.dataframe_pickle import (
    MAX_TABLE_ROWS,
    Table,
    read_table_bytes,
)
from lidarpainter_models.readers.source_logs.folder import SourceFolder
from lidarpainter_models.scenes.validation import shown


def read_table(
    source: SourceFolder,
    name: str,
    numbers: tuple[str, ...],
    *,
    texts: tuple[str, ...] = (),
    max_rows: int = MAX_TABLE_ROWS,
) -> Table:
    """The named columns of one table, gzipped under this name or unpacked under it without `.gz`.

    Columns of numbers and flags come as float64 or int64, columns of texts as they are.

    Raises:
        DataError: the file cannot be read, or lacks a column.
    """
    if not (source.root / name).exists() and (source.root / name).with_suffix("").exists():
        name = name.removesuffix(".gz")
    path = source.root / name
    table = read_table_bytes(source.read_bytes(name), path, max_rows=max_rows)
    missing = [column for column in (*numbers, *texts) if column not in table]
    if missing:
        found = shown(", ".join(table))
        raise DataError(f"{path}: no column {', '.join(missing)}; it has {found}")
    return {
        **{column: _numbers(table[column], f"{path}, column {column}") for column in numbers},
        **{column: table[column] for column in texts},
    }


def _numbers(column: np.ndarray, where: str) -> np.ndarray:
    kind = np.int64 if column.dtype.kind in "biu" else np.float64
    try:
        return column.astype(kind, copy=False)
    except (TypeError, ValueError, OverflowError):
        raise DataError(f"{where}: holds something other than numbers") from None
