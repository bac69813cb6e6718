"""Change single fields of Waymo's messages and columns of its tables, to be refused."""

import pyarrow as pa
import pytest
from waymo_damage import joined, split
from waymo_numbers import SEGMENT

from lidarpainter_models.errors import DataError

CONTEXT, TIME, POSE, IMAGES, LASERS, LABELS = 1, 2, 3, 4, 5, 6
CAMERAS, LIDARS = 2, 3
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
