"""Tables of Feather files (Arrow's file format, version 2) as downloaded.

Every column that is asked for must be there, of the kind that is asked for, and whole. A buffer of
a compressed file says in its first eight bytes what it takes unpacked, and a library allocates what
it says, so the sizes are added up before anything is unpacked. The footer and the heads of the
batches are FlatBuffers (https://arrow.apache.org/docs/format/Columnar.html, File.fbs, Message.fbs).
"""

import struct
from collections.abc import Iterator, Mapping
from typing import Literal

import numpy as np
import pyarrow as pa
import torch
from jaxtyping import Float
from torch import Tensor

from lidarpainter_models.errors import DataError
from lidarpainter_models.geometry.transforms import rigid_from_rotation, rotation_from_quaternion
from lidarpainter_models.readers.source_logs.drive_poses import MAX_UNIT, MIN_UNIT
from lidarpainter_models.readers.source_logs.folder import SourceFolder
from lidarpainter_models.scenes.validation import shown

Kind = Literal["number", "whole", "text"]
"""Finite numbers as float64, whole numbers as int64, or texts."""
MAX_TABLE_BYTES = 256 << 20
"""When unpacked; a sweep of two LiDARs takes 1.4 MB, the boxes of a log as much."""
MAX_TABLE_ROWS = 2_000_000
_MAGIC = b"ARROW1"
_BLOCK_BYTES = 24
_BUFFER_BYTES = 16
_DICTIONARY_BATCH = 2


def read_feather(
    source: SourceFolder, name: str, columns: Mapping[str, Kind]
) -> dict[str, np.ndarray]:
    """Some columns of one file.

    Args:
        source: the folder that holds the file, which remembers its digest.
        name: of the file, from that folder.
        columns: what is read, and of which kind it must be.

    Returns:
        An array for each column; texts as an array of objects.

    Raises:
        DataError: the file is missing, damaged or too large, or a column is missing or of another
            kind.
    """
    where, content = str(source.root / name), source.read_bytes(name)
    try:
        unpacked = _unpacked_bytes(content)
    except (struct.error, ValueError, RecursionError) as error:
        raise DataError(f"{where}: not a Feather file of version 2 ({error})") from None
    if unpacked > MAX_TABLE_BYTES:
        raise DataError(
            f"{where}: {unpacked} bytes when unpacked, expected {MAX_TABLE_BYTES} at most"
        )
    try:
        table = _table(content, columns, where)
    except (pa.ArrowException, OSError, ValueError, OverflowError, MemoryError) as error:
        if isinstance(error, DataError):
            raise
        reason = shown(" ".join(str(error).split())) or type(error).__name__
        raise DataError(f"{where}: cannot be read as Feather ({reason})") from None
    return {
        column: _values(table[column], kind, f"{where}, {column}")
        for column, kind in columns.items()
    }


def _table(content: bytes, columns: Mapping[str, Kind], where: str) -> pa.Table:
    """The wanted columns, as Arrow has checked them."""
    fields = pa.ipc.open_file(pa.py_buffer(content)).schema.names
    for column in columns:
        if fields.count(column) != 1:
            known = shown(", ".join(fields))
            raise DataError(f"{where}: no column {column} or several, expected it among {known}")
    wanted = [fields.index(column) for column in columns]
    options = pa.ipc.IpcReadOptions(included_fields=wanted, use_threads=False)
    table = pa.ipc.open_file(pa.py_buffer(content), options=options).read_all()
    if table.num_rows > MAX_TABLE_ROWS:
        raise DataError(f"{where}: {table.num_rows} rows, expected {MAX_TABLE_ROWS} at most")
    table.validate(full=True)
    return table


def _values(column: pa.ChunkedArray, kind: Kind, where: str) -> np.ndarray:
    if column.null_count:
        raise DataError(f"{where}: a value is absent")
    return _texts(column, where) if kind == "text" else _numbers(column, kind, where)


def _texts(column: pa.ChunkedArray, where: str) -> np.ndarray:
    if pa.types.is_dictionary(column.type):
        column = column.cast(column.type.value_type)
    if not (pa.types.is_string(column.type) or pa.types.is_large_string(column.type)):
        raise DataError(f"{where}: is {column.type}, expected texts")
    return np.array(column.to_pylist(), dtype=object)


def _numbers(column: pa.ChunkedArray, kind: Kind, where: str) -> np.ndarray:
    is_whole = pa.types.is_integer(column.type)
    if not is_whole and (kind == "whole" or not pa.types.is_floating(column.type)):
        expected = "whole numbers" if kind == "whole" else "numbers"
        raise DataError(f"{where}: is {column.type}, expected {expected}")
    values = column.to_numpy()
    if kind == "whole":
        if len(values) and values.max() > np.iinfo(np.int64).max:
            raise DataError(f"{where}: {values.max()} is larger than 64 bits hold")
        return values.astype(np.int64)
    values = values.astype(np.float64)
    if not np.isfinite(values).all():
        row = int(np.flatnonzero(~np.isfinite(values))[0])
        raise DataError(f"{where}, row {row}: {values[row]}, expected a finite number")
    return values


def _unpacked_bytes(content: bytes) -> int:
    """What all batches of a file take in memory."""
    if not content.startswith(_MAGIC) or not content.endswith(_MAGIC):
        raise ValueError("it does not begin and end with ARROW1")
    (length,) = struct.unpack_from("<i", content, len(content) - len(_MAGIC) - 4)
    start = len(content) - len(_MAGIC) - 4 - length
    if length < 8 or start < len(_MAGIC):
        raise ValueError(f"its footer has {length} bytes")
    (root,) = struct.unpack_from("<I", content, start)
    footer = start + root
    blocks = [at for field in (2, 3) for at in _structs(content, footer, field, _BLOCK_BYTES)]
    return sum(_batch_bytes(content, *struct.unpack_from("<qi4xq", content, at)) for at in blocks)


def _batch_bytes(content: bytes, offset: int, head_bytes: int, body_bytes: int) -> int:
    """What one batch takes: what its buffers say, or their size where they are not compressed."""
    if offset < 0 or head_bytes < 8 or body_bytes < 0:
        raise ValueError(f"a batch is said to lie at {offset}")
    marker, _ = struct.unpack_from("<Ii", content, offset)
    head = offset + (8 if marker == 0xFFFFFFFF else 4)
    (root,) = struct.unpack_from("<I", content, head)
    message = head + root
    batch, kind_at = _table_at(content, message, 2), _field(content, message, 1)
    if kind_at and content[kind_at] == _DICTIONARY_BATCH:
        batch = _table_at(content, batch, 1)
    body, is_packed = offset + head_bytes, bool(_field(content, batch, 3))
    total = 0
    for at in _structs(content, batch, 2, _BUFFER_BYTES):
        start, length = struct.unpack_from("<qq", content, at)
        if start < 0 or length < 0 or body + start + length > len(content):
            raise ValueError(f"a buffer of {length} bytes is said to lie at {start}")
        (stated,) = struct.unpack_from("<q", content, body + start) if is_packed and length else [0]
        total += max(stated, length)
    return total


def _field(content: bytes, table: int, number: int) -> int:
    """Where a field of a FlatBuffers table lies; 0 where it is left out."""
    (back,) = struct.unpack_from("<i", content, table)
    if not 0 <= table - back <= len(content):
        raise ValueError("a table of the footer leads outside")
    (size,) = struct.unpack_from("<H", content, table - back)
    if 4 + 2 * number >= size:
        return 0
    (offset,) = struct.unpack_from("<H", content, table - back + 4 + 2 * number)
    return table + offset if offset else 0


def _table_at(content: bytes, table: int, number: int) -> int:
    at = _field(content, table, number)
    if not at:
        raise ValueError("a batch has no content")
    return at + int(struct.unpack_from("<I", content, at)[0])


def _structs(content: bytes, table: int, number: int, width: int) -> Iterator[int]:
    """Where the structs of a list lie."""
    if not (at := _field(content, table, number)):
        return iter(())
    start = at + int(struct.unpack_from("<I", content, at)[0])
    (count,) = struct.unpack_from("<I", content, start)
    if start + 4 + count * width > len(content):
        raise ValueError(f"a list of {count} entries reaches beyond the file")
    return iter(range(start + 4, start + 4 + count * width, width))


def stated_poses(table: Mapping[str, np.ndarray], where: str) -> Float[Tensor, "rows 4 4"]:
    """Poses of the columns qw qx qy qz tx_m ty_m tz_m, float64.

    Raises:
        DataError: a rotation is no unit quaternion.
    """
    rotation_wxyz = torch.from_numpy(np.stack([table[f"q{axis}"] for axis in "wxyz"], axis=1))
    length = rotation_wxyz.norm(dim=1)
    wrong = (~((length > MIN_UNIT) & (length < MAX_UNIT))).nonzero()
    if len(wrong):
        row = int(wrong[0, 0])
        raise DataError(f"{where}, row {row}: a rotation of length {length[row]:.3g}, expected 1")
    translation_m = torch.from_numpy(np.stack([table[f"t{axis}_m"] for axis in "xyz"], axis=1))
    return rigid_from_rotation(rotation_from_quaternion(rotation_wxyz), translation_m)
