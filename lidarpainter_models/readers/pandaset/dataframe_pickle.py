"""Read pickled pandas tables (PandaSet's files) without pandas and without running the pickle.

`pickle_tree` turns the file into inert data; this module knows how pandas arranges a table in it:
a `BlockManager` holds blocks, each a 2-D array (columns, rows) with the positions of its columns,
and two indexes, the first of which has the column names. Understood are the states of
pandas 0.25 to 2 (and 3 where texts are plain objects); contents are flags, numbers and texts.
"""

import operator
import re
import zlib
from pathlib import Path
from typing import Any

import numpy as np

from lidarpainter_models.errors import DataError, UnsafePickleError
from lidarpainter_models.readers.pandaset.pickle_tree import Made, Named, read_pickle_tree
from lidarpainter_models.readers.source_logs.folder import SourceFolder
from lidarpainter_models.scenes.validation import shown

MAX_TABLE_BYTES = 64 * 1024 * 1024
"""A table that unpacks to more is refused; the largest of PandaSet has 9 MB."""
MAX_TABLE_ROWS = 1_000_000
"""A frame of PandaSet has 170,000 points."""
_MAX_MEMBERS = 16
"""Of a gzip file; those of PandaSet have one."""
_GZIP_WINDOW_BITS = 31
"""For zlib: a gzip header, its checksum and the largest window."""

Table = dict[str, np.ndarray]
"""Columns by name, all of one length."""


def _known_as(name: str, *modules: str) -> frozenset[Named]:
    return frozenset(Named(module, name) for module in modules)


_FRAMES = _known_as("DataFrame", "pandas.core.frame", "pandas")
_INTERNALS = "pandas.core.internals"
_MANAGERS = _known_as("BlockManager", f"{_INTERNALS}.managers", _INTERNALS)
_NEW_INDEX = _known_as("_new_Index", "pandas.core.indexes.base")
_INDEX_KINDS = (
    _known_as("Index", "pandas.core.indexes.base", "pandas")
    | _known_as("RangeIndex", "pandas.core.indexes.range", "pandas")
    | _known_as("Int64Index", "pandas.core.indexes.numeric")
)
_BLOCKS = _known_as("_unpickle_block", "pandas._libs.internals")
_BLOCKS |= _known_as("new_block", f"{_INTERNALS}.blocks")
_SLICES = _known_as("slice", "builtins", "__builtin__")
_ENCODE = _known_as("encode", "_codecs")
_DTYPE = _known_as("dtype", "numpy")
_RECONSTRUCT = _known_as("_reconstruct", "numpy.core.multiarray", "numpy._core.multiarray")
_FROM_BUFFER = _known_as("_frombuffer", "numpy.core.numeric", "numpy._core.numeric")
ALLOWED_NAMES = frozenset().union(
    *(_FRAMES, _MANAGERS, _NEW_INDEX, _INDEX_KINDS, _BLOCKS, _SLICES, _ENCODE, _DTYPE),
    *(_RECONSTRUCT, _FROM_BUFFER, _known_as("ndarray", "numpy")),
)
_NUMBER_CODE = re.compile(r"b1|[iu][1248]|f[248]")
_GZIP_MAGIC = b"\x1f\x8b"
_BYTE_ORDERS = ("<", ">", "=", "|")


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


def read_table_bytes(
    content: bytes, path: Path, *, max_bytes: int = MAX_TABLE_BYTES, max_rows: int = MAX_TABLE_ROWS
) -> Table:
    """The columns of one pickled pandas table, gzipped or, as some mirrors have it, unpacked.

    Raises:
        DataError: the content is cut off, too large or no table.
        UnsafePickleError: the pickle names a class that no table needs.
    """
    try:
        content = _unpacked(content, max_bytes)
        return _table(read_pickle_tree(content, ALLOWED_NAMES), max_rows)
    except UnsafePickleError as error:
        raise UnsafePickleError(f"{path}: {error}") from None
    except DataError as error:
        raise DataError(f"{path}: {error}") from None


def _unpacked(content: bytes, max_bytes: int) -> bytes:
    """The content of a file that may be gzipped; no more than `max_bytes`."""
    if content.startswith(_GZIP_MAGIC):
        return _unzip(content, max_bytes)
    if len(content) > max_bytes:
        raise DataError(f"has more than {max_bytes} bytes, expected a table")
    return content


def _unzip(content: bytes, max_bytes: int) -> bytes:
    """The content of a gzip file, which may have several members; no more than `max_bytes`."""
    parts, left = [], max_bytes + 1
    for _ in range(_MAX_MEMBERS):
        if not content:
            break
        member = zlib.decompressobj(_GZIP_WINDOW_BITS)
        try:
            parts.append(member.decompress(content, left))
        except zlib.error as error:
            raise DataError(f"the gzip file is cut off or damaged ({error})") from None
        left -= len(parts[-1])
        if left <= 0:
            raise DataError(f"unpacks to more than {max_bytes} bytes, expected a table")
        if not member.eof:
            raise DataError("the gzip file is cut off or damaged (it has no end)")
        content = member.unused_data.lstrip(b"\x00")
    if content:
        raise DataError(f"has more than {_MAX_MEMBERS} gzip members, expected a table")
    return b"".join(parts)


def _table(tree: object, max_rows: int) -> Table:
    if not (isinstance(tree, Made) and tree.by in _FRAMES and isinstance(tree.state, dict)):
        raise DataError("the pickle holds no pandas table")
    manager = tree.state.get("_mgr", tree.state.get("_data"))
    if not (isinstance(manager, Made) and manager.by in _MANAGERS):
        raise DataError("the pandas table has a layout that is not understood")
    try:
        names, placed = _blocks(manager)
        columns: list[np.ndarray | None] = [None] * len(names)
        for values, positions in placed:
            for row, position in enumerate(positions):
                columns[position] = values[row]
    except (TypeError, ValueError, KeyError, IndexError, AttributeError, OverflowError) as error:
        if isinstance(error, DataError):
            raise
        raise DataError(f"the pandas table is damaged ({shown(str(error))})") from None
    return dict(zip(names, _of_one_length(columns, max_rows), strict=True))


def _of_one_length(columns: list[np.ndarray | None], max_rows: int) -> list[np.ndarray]:
    found = [column for column in columns if column is not None]
    lengths = {len(column) for column in found}
    if len(found) != len(columns) or len(lengths) != 1:
        raise DataError("the pandas table is damaged (columns are missing or differ in length)")
    if max(lengths) > max_rows:
        raise DataError(f"the table has {max(lengths)} rows, expected at most {max_rows}")
    return found


def _blocks(manager: Made) -> tuple[list[str], list[tuple[np.ndarray, list[int]]]]:
    """Column names, and per block its (columns, rows) array and the positions of its columns."""
    if isinstance(manager.state, tuple):  # pandas 0.25 to 1.2: everything in the state
        layout = manager.state[3]["0.14.1"]
        axes, blocks = layout["axes"], layout["blocks"]
        pairs = [(block["values"], block["mgr_locs"]) for block in blocks]
    else:  # pandas 1.3 and later: BlockManager(blocks, axes)
        blocks, axes = manager.arguments
        pairs = [block.arguments[:2] for block in blocks if block.by in _BLOCKS]
        if len(pairs) != len(blocks):
            raise DataError("the pandas table has a block that is not understood")
    names = [str(name) for name in _index_values(axes[0])]
    return names, [
        (np.atleast_2d(_array(values)), _positions(placement, len(names)))
        for values, placement in pairs
    ]


def _index_values(index: Made) -> list[Any]:
    if index.by not in _NEW_INDEX or len(index.arguments) != 2:
        raise DataError("the column names of the pandas table are not understood")
    return list(_array(index.arguments[1]["data"]))


def _positions(placement: Made, count: int) -> list[int]:
    if placement.by in _SLICES:
        start, stop, step = placement.arguments
        return list(range(count))[slice(start, stop, step)]
    return [int(position) for position in _array(placement)]


def _array(made: Made) -> np.ndarray:
    """The array of a numpy pickle, from its raw bytes and a type we name ourselves."""
    if made.by in _RECONSTRUCT:
        _version, shape, dtype, is_fortran, content = made.state
        order = "F" if is_fortran else "C"
    elif made.by in _FROM_BUFFER:
        content, dtype, shape, order = made.arguments
    else:
        raise DataError(f"an array is made by {made.by}, which is not understood")
    if isinstance(content, Made) and content.by in _ENCODE:
        content = content.arguments[0]
    sizes = tuple(operator.index(size) for size in shape)
    if not 1 <= len(sizes) <= 2 or min(sizes) < 0:
        raise DataError("an array is neither a column nor a block of columns")
    return _flat_array(content, _dtype(dtype)).reshape(sizes, order="F" if order == "F" else "C")


def _flat_array(content: object, kind: np.dtype) -> np.ndarray:
    if kind.hasobject:
        if not isinstance(content, list):
            raise DataError("a column of texts holds something else")
        flat = np.empty(len(content), dtype=object)
        flat[:] = [_plain_value(item) for item in content]
        return flat
    raw = content.encode("latin1") if isinstance(content, str) else content
    if not isinstance(raw, bytes | bytearray):
        raise DataError("a column of numbers holds something else")
    return np.frombuffer(raw, dtype=kind)


def _dtype(dtype: Made) -> np.dtype:
    text = dtype.arguments[0]
    code = text.lstrip("<>|=") if isinstance(text, str) else ""
    if dtype.by not in _DTYPE or (code[:1] != "O" and not _NUMBER_CODE.fullmatch(code)):
        raise DataError(f"column type {code!r:.50} is not a number, a flag or a text")
    if code[:1] == "O":
        return np.dtype(object)
    byte_order = dtype.state[1] if dtype.state else "="
    return np.dtype((byte_order if byte_order in _BYTE_ORDERS else "=") + code)


def _plain_value(item: object) -> object:
    if item is None or isinstance(item, str | int | float | bool):
        return item
    raise DataError("a column of texts holds something else")
