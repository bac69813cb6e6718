"""Damage Waymo's files below their checksums: messages, matrices and tables that look whole.

Every way takes a seeded `numpy.random.Generator`. `damaged_record_file` gives a TFRecord file,
`damaged_component` one Parquet file of a folder; both say what was done.
"""

import io
import struct
import zlib

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from mutations import STRANGE_NUMBERS, TRAVERSALS, Damage, damaged_bytes
from waymo_records import matrix, message, tfrecord, varint, whole

FRAME_IMAGES, FRAME_LASERS, FRAME_LABELS = 4, 5, 6
_VARINT, _DOUBLE, _BYTES, _GROUP, _FLOAT = 0, 1, 2, 3, 5
_STRANGE_WHOLES = (0, 1, 7, 2**31 - 1, 2**31, 2**32 - 1, 2**63 - 1, 2**63, 2**64 - 1)


def damaged_record_file(records, rng):
    """A TFRecord file made of records, one of which (or the file itself) is damaged."""
    records = list(records)
    index = int(rng.integers(len(records)))
    ways = (_file_bytes, _record_bytes, _any_field, _any_field, _any_field, _range_image, _records)
    way = ways[rng.integers(len(ways))]
    damage = way(records, index, rng)
    return Damage(damage.content, f"{way.__name__} of record {index}: {damage.description}")


def _file_bytes(records, index, rng):
    """The checksums are not repaired."""
    del index
    return damaged_bytes(tfrecord(records), rng)


def _record_bytes(records, index, rng):
    damage = damaged_bytes(records[index], rng)
    records[index] = damage.content
    return Damage(tfrecord(records), damage.description)


def _any_field(records, index, rng):
    records[index], description = damaged_message(records[index], rng)
    return Damage(tfrecord(records), description)


def _records(records, index, rng):
    """Records out of order, twice, or none."""
    ways = {
        "twice": lambda: [*records, records[index]],
        "turned around": lambda: records[::-1],
        "alone": lambda: [records[index]],
        "gone": list,
        "empty": lambda: [*records[:index], b"", *records[index + 1 :]],
    }
    name = list(ways)[rng.integers(len(ways))]
    return Damage(tfrecord(ways[name]()), name)


def _range_image(records, index, rng):
    """A compressed matrix of a LiDAR is replaced by a damaged one that unpacks, or by a bomb."""
    fields = split(records[index])
    lasers = [place for place, field in enumerate(fields) if field[0] == FRAME_LASERS]
    place = lasers[rng.integers(len(lasers))]
    laser = split(fields[place][2])
    echo = int(rng.integers(1, len(laser)))
    image = split(laser[echo][2])
    part = int(rng.integers(len(image)))
    content, description = _damaged_matrix(zlib.decompress(image[part][2]), rng)
    image[part] = (image[part][0], _BYTES, zlib.compress(content, 1))
    laser[echo] = (laser[echo][0], _BYTES, joined(image))
    fields[place] = (FRAME_LASERS, _BYTES, joined(laser))
    records[index] = joined(fields)
    return Damage(tfrecord(records), description)


def _damaged_matrix(content, rng):
    (_, _, data), (_, _, shape) = split(content)
    dims = [value for _, _, value in split(shape)]
    values = np.frombuffer(data, "<f4").reshape(dims).copy()
    way = int(rng.integers(6))
    if way == 0:
        number = rng.choice([np.nan, np.inf, -np.inf, 3e38, -3e38, 0.0, 1e-40, 500.0])
        values.reshape(-1)[rng.integers(values.size)] = number
        return matrix(values), f"a value is {number}"
    if way == 1:
        dims[rng.integers(len(dims))] = int(rng.choice([0, 1, 7, 2**31 - 1, 65536]))
        numbers = b"".join(whole(1, size) for size in dims)
        return message(1, data) + message(2, numbers), f"shape {dims}"
    if way == 2:
        return bytes(int(rng.choice([10**6, 2 * 10**8]))), "a bomb of zeros"
    if way == 3:
        number = rng.choice([np.nan, np.inf, 1e30, 0.0])
        return matrix(np.full_like(values, number)), f"all values are {number}"
    if way == 4:
        return matrix(values[:, : max(values.shape[1] // 2, 1)]), "half of the columns"
    damage = damaged_bytes(content, rng)
    return damage.content, f"inside the matrix: {damage.description}"


def damaged_message(content, rng):
    """Change one field somewhere in a message, as deep as chance has it."""
    fields = split(content)
    if not fields:
        return content + b"\x0a\x00", "a field added"
    place = int(rng.integers(len(fields)))
    number, kind, value = fields[place]
    inner = split(value) if kind == _BYTES and len(value) < 20_000 else None
    if inner and rng.random() < 0.85:
        changed, description = damaged_message(value, rng)
        fields[place] = (number, kind, changed)
        return joined(fields), f"{number}.{description}"
    replaced, description = _damaged_field(number, kind, value, rng)
    fields[place : place + 1] = replaced
    return joined(fields), f"{number} {description}"


def _damaged_field(number, kind, value, rng):
    """One field becomes none, two, another, or many."""
    way = int(rng.integers(7))
    if way == 0:
        return [], "is gone"
    if way == 1:
        count = int(rng.choice([2, 50, 20_000]))
        return [(number, kind, value)] * count, f"stands {count} times"
    if way == 2:
        other = int(rng.choice([_VARINT, _DOUBLE, _BYTES, _FLOAT]))
        filler = {_VARINT: 5, _DOUBLE: 1.5, _BYTES: b"\x08\x01", _FLOAT: 1.5}[other]
        return [(number, other, filler)], f"has wire type {other}"
    if way == 3:
        depth = int(rng.choice([3, 90, 5000]))
        return [(number, _GROUP, depth)], f"is {depth} groups inside each other"
    if kind == _BYTES:
        if way == 4:
            text = TRAVERSALS[rng.integers(len(TRAVERSALS))].encode("utf-8", "surrogatepass")
            return [(number, kind, text)], f"is {text[:20]!r}"
        damage = damaged_bytes(value, rng)
        return [(number, kind, damage.content)], damage.description
    if kind == _VARINT:
        strange = int(rng.choice(np.array(_STRANGE_WHOLES, dtype=object)))
        return [(number, kind, strange)], f"is {strange}"
    numbers = [float(x) for x in STRANGE_NUMBERS if abs(x) < 1e300 or x != x or x in (1e308,)]
    near = value * float(rng.choice([-1.0, 0.5, 1.001, 2.0]))
    new = float(rng.choice([*numbers, near, near, near]))
    return [(number, kind, new)], f"is {new} instead of {value}"


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


# --- version 2


def damaged_component(folder, rng):
    """One Parquet file of a folder, and what is to stand in it: other bytes, or another table."""
    paths = sorted(folder.glob("*/*.parquet"))
    path = paths[rng.integers(len(paths))]
    if rng.random() < 0.4:
        return path, damaged_bytes(path.read_bytes(), rng)
    table = pq.read_table(path)
    ways = (_column_gone, _column_of_texts, _null, _strange_value, _rows_moved, _strange_value)
    table, description = ways[rng.integers(len(ways))](table, rng)
    written = io.BytesIO()
    pq.write_table(table, written, row_group_size=int(rng.choice([1, 2, 5, 1000])))
    return path, Damage(written.getvalue(), description)


def _column_gone(table, rng):
    name = table.schema.names[rng.integers(table.num_columns)]
    return table.drop_columns([name]), f"no {name}"


def _column_of_texts(table, rng):
    name = table.schema.names[rng.integers(table.num_columns)]
    texts = pa.array(["../../x"] * table.num_rows)
    return _with(table, name, texts), f"{name} holds texts"


def _null(table, rng):
    name = table.schema.names[rng.integers(table.num_columns)]
    values = table[name].to_pylist()
    if values:
        values[rng.integers(len(values))] = None
    return _with(table, name, pa.array(values, type=table.schema.field(name).type)), f"{name} null"


def _strange_value(table, rng):
    """One value, or one of the list that it is, becomes another of the same type."""
    name = table.schema.names[rng.integers(table.num_columns)]
    kind = table.schema.field(name).type
    values = table[name].to_pylist()
    if not values:
        return table, "nothing to change"
    row = int(rng.integers(len(values)))
    if isinstance(values[row], list) and values[row]:
        values[row][rng.integers(len(values[row]))] = _strange(kind.value_type, rng)
    else:
        values[row] = _strange(kind, rng)
    return _with(
        table, name, pa.array(values, type=kind)
    ), f"{name}, row {row}: {values[row]!r:.60}"


def _strange(kind, rng):
    if pa.types.is_floating(kind):
        return float(rng.choice([np.nan, np.inf, -np.inf, 1e30, -1e30, 0.0, 1e-30, 100.0]))
    if pa.types.is_integer(kind):
        limit = 2 ** (kind.bit_width - 1)
        return int(rng.choice(np.array([0, -1, 1, 7, limit - 1, -limit], dtype=object)))
    text = TRAVERSALS[rng.integers(len(TRAVERSALS))]
    if pa.types.is_string(kind):
        return text.encode("utf-8", "replace").decode()
    return text.encode("utf-8", "replace") if pa.types.is_binary(kind) else None


def _rows_moved(table, rng):
    """Rows twice, gone, or in another order."""
    rows = np.arange(table.num_rows)
    way = ("twice", "gone", "shuffled", "none")[rng.integers(4)]
    if way == "twice":
        rows = np.repeat(rows, 2)
    elif way == "gone" and len(rows):
        rows = np.delete(rows, rng.integers(len(rows)))
    elif way == "shuffled":
        rows = rng.permutation(rows)
    elif way == "none":
        rows = rows[:0]
    return table.take(pa.array(rows, type=pa.int64())), f"rows {way}"


def _with(table, name, column):
    place = table.schema.get_field_index(name)
    return table.set_column(place, name, column)
