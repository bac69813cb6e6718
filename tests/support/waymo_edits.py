"""Change single fields of Waymo's messages and columns of its tables, to be refused."""

import struct

import pyarrow as pa
import pytest
from waymo_numbers import SEGMENT
from waymo_records import varint

from lidarpainter_models.errors import DataError

CONTEXT, TIME, POSE, IMAGES, LASERS, LABELS = 1, 2, 3, 4, 5, 6
CAMERAS, LIDARS = 2, 3
_VARINT, _DOUBLE, _BYTES, _GROUP, _FLOAT = 0, 1, 2, 3, 5
FILE = f"segment-{SEGMENT}_with_camera_labels.tfrecord"


def refused_line(folder, store, named):
    with pytest.raises(DataError) as raised:
        folder.ingest(store)
    assert [path for path in store.rglob("*") if path.is_file()] == []
    line = str(raised.value)
    assert "\n" not in line
    assert named in line
    return line


def edited(content, path, change):
    """A message with one field, found by numbers and positions, replaced by what `change` gives.

    `path` is field numbers, each with the position among its equals (`4`, or `(4, 1)`); `change`
    takes the field's value and gives a new one, or None to remove it.
    """
    number, position = path[0] if isinstance(path[0], tuple) else (path[0], 0)
    fields = split(content)
    place = [place for place, field in enumerate(fields) if field[0] == number][position]
    _, kind, value = fields[place]
    new = edited(value, path[1:], change) if path[1:] else change(value)
    fields[place : place + 1] = [] if new is None else [(number, kind, new)]
    return joined(fields)


def with_frame(messages, path, change, index=1):
    """The records with one field of one frame changed."""
    changed = edited(messages[index], path, change)
    return [*messages[:index], changed, *messages[index + 1 :]]


def everywhere(messages, path, change):
    """The records with one field of every frame changed, as for what all of them repeat."""
    return [edited(record, path, change) for record in messages]


def with_value(column, row, value):
    def changed(table):
        values = table[column].to_pylist()
        values[row] = value
        kind = table.schema.field(column).type
        place = table.schema.get_field_index(column)
        return table.set_column(place, column, pa.array(values, type=kind))

    return changed


def records_in(content):
    """The records of a TFRecord file, without their lengths and checksums."""
    found, position = [], 0
    while position < len(content):
        (num_bytes,) = struct.unpack_from("<Q", content, position)
        found.append(content[position + 12 : position + 12 + num_bytes])
        position += num_bytes + 16
    return found


def split(content):
    """The fields of a message as (number, wire type, value), or None if it is none."""
    found, position = [], 0
    while position < len(content):
        key, position = _read_varint(content, position)
        number, kind = (key or 0) >> 3, (key or 0) & 7
        if key is None or number == 0:
            return None
        if kind == _VARINT:
            value, position = _read_varint(content, position)
        elif kind in (_DOUBLE, _FLOAT):
            form = "<d" if kind == _DOUBLE else "<f"
            end = position + struct.calcsize(form)
            value = struct.unpack(form, content[position:end])[0] if end <= len(content) else None
            position = end
        elif kind == _BYTES:
            size, position = _read_varint(content, position)
            end = position + (size if size is not None else len(content) + 1)
            value = content[position:end] if end <= len(content) else None
            position = end
        else:
            return None
        if value is None:
            return None
        found.append((number, kind, value))
    return found


def joined(fields):
    """The inverse of `split`; a group's value is how deep it nests."""
    parts = []
    for number, kind, value in fields:
        key = varint(number << 3 | kind)
        if kind == _VARINT:
            parts.append(key + varint(value))
        elif kind == _BYTES:
            parts.append(key + varint(len(value)) + value)
        elif kind == _GROUP:
            parts.append(key * value + varint(number << 3 | 4) * value)
        else:
            parts.append(key + _packed("<d" if kind == _DOUBLE else "<f", value))
    return b"".join(parts)


def _packed(form, value):
    try:
        return struct.pack(form, value)
    except OverflowError:
        return struct.pack(form, float("inf"))


def _read_varint(content, position):
    value = shift = 0
    while position < len(content) and shift < 64:
        byte = content[position]
        position += 1
        value |= (byte & 0x7F) << shift
        shift += 7
        if byte < 0x80:
            return value, position
    return None, position
