"""What the pages of a Parquet file take when unpacked, as their own headers say.

The footer says it too, but a library allocates what a header says, so a footer that says little
keeps nobody from gigabytes. A header is a struct of Thrift's compact protocol
(https://github.com/apache/parquet-format); it is read as every writer writes it, and refused if it
is written otherwise.
"""

import mmap
from pathlib import Path

import pyarrow.parquet as pq

VALUE_BYTES = 8
"""Of a number in memory; one that is repeated takes next to none in a file."""
_DATA_PAGE, _DICTIONARY_PAGE, _DATA_PAGE_V2 = 0, 2, 3
_NUM_VALUES_OF = {_DATA_PAGE: (5, 1), _DICTIONARY_PAGE: (7, 1), _DATA_PAGE_V2: (8, 1)}
"""Fields of a header: the struct about its kind of page, and the number of values in that."""
_TRUE, _FALSE, _INT32, _INT64, _BINARY, _STRUCT = 1, 2, 5, 6, 8, 12
_DEEPEST = 3
"""Structs within each other: a header, what it says of its page, statistics of that."""

_Fields = dict[tuple[int, ...], int]


def unpacked_bytes(file: Path, footer: pq.FileMetaData) -> list[int]:
    """What each row group takes in memory; reads the headers of all its pages.

    Raises:
        ValueError: a header is not where the footer says, or is none.
        OSError: the file cannot be read.
    """
    with file.open("rb") as opened, mmap.mmap(opened.fileno(), 0, access=mmap.ACCESS_READ) as data:
        groups = [footer.row_group(number) for number in range(footer.num_row_groups)]
        return [
            sum(_of_column(data, group.column(index)) for index in range(group.num_columns))
            for group in groups
        ]


def _of_column(data: mmap.mmap, column: pq.ColumnChunkMetaData) -> int:
    """The sum over the pages that hold the values of a column."""
    at, num_values, num_bytes = column.data_page_offset, 0, 0
    if column.has_dictionary_page and 0 < column.dictionary_page_offset < at:
        at = column.dictionary_page_offset
    while num_values < column.num_values:
        header: _Fields = {}
        end = _read_struct(data, at, (), header)
        try:
            kind, unpacked, packed = header[1,], header[2,], header[3,]
            held = header[_NUM_VALUES_OF[kind]] if kind in _NUM_VALUES_OF else 0
        except KeyError:
            raise ValueError(f"the page at {at} says no size") from None
        if min(unpacked, packed, held) < 0:
            raise ValueError(f"the page at {at} has a size below 0")
        num_bytes += max(unpacked, VALUE_BYTES * held)
        num_values += held if kind != _DICTIONARY_PAGE else 0
        at = end + packed
    return num_bytes


def _read_struct(data: mmap.mmap, at: int, within: tuple[int, ...], found: _Fields) -> int:
    """Note the 32-bit numbers of a struct by the fields that lead to them; returns its end."""
    field = 0
    while head := _byte(data, at):
        at += 1
        step, kind = divmod(head, 16)
        field += step
        if step == 0 or (kind == _STRUCT and len(within) == _DEEPEST):
            raise ValueError(f"no header of a page at {at}")
        if kind in (_INT32, _INT64, _BINARY):
            number, at = _read_varint(data, at, most_bits=32 if kind == _INT32 else 64)
            if kind == _INT32:
                found[*within, field] = (number >> 1) ^ -(number & 1)
            elif kind == _BINARY:
                at += number
        elif kind == _STRUCT:
            at = _read_struct(data, at, (*within, field), found)
        elif kind not in (_TRUE, _FALSE):
            raise ValueError(f"no header of a page at {at}")
    return at + 1


def _read_varint(data: mmap.mmap, at: int, *, most_bits: int) -> tuple[int, int]:
    number = bits = 0
    while bits < most_bits:
        byte = _byte(data, at)
        at += 1
        number |= (byte & 127) << bits
        bits += 7
        if byte < 128 and number >> most_bits == 0:
            return number, at
    raise ValueError(f"no number of {most_bits} bits before {at}")


def _byte(data: mmap.mmap, at: int) -> int:
    if not 0 <= at < len(data):
        raise ValueError(f"a page lies at {at}, outside of the file")
    return data[at]
