"""Pickles of pandas tables, written by hand as pandas 1 and 2 write them (pandas is not needed)."""

import struct

import numpy as np


def _name(module: str, name: str) -> bytes:
    return f"c{module}\n{name}\n".encode()


def _text(text: str) -> bytes:
    content = text.encode()
    return b"X" + struct.pack("<I", len(content)) + content


def _integer(value: int) -> bytes:
    return b"J" + struct.pack("<i", value)


def _tuple(*items: bytes) -> bytes:
    return b"(" + b"".join(items) + b"t"


def _list(*items: bytes) -> bytes:
    return b"](" + b"".join(items) + b"e"


def _dict(items: dict[str, bytes]) -> bytes:
    return b"}(" + b"".join(_text(key) + value for key, value in items.items()) + b"u"


def _value(value: object) -> bytes:
    if isinstance(value, float):
        return b"G" + struct.pack(">d", value)
    return b"N" if value is None else _text(str(value))


def _array(array: np.ndarray) -> bytes:
    kind = "O8" if array.dtype.hasobject else array.dtype.str[1:]
    order = "|" if kind in ("O8", "b1") else "<"
    dtype = _name("numpy", "dtype") + _tuple(_text(kind), _integer(0), _integer(1)) + b"R"
    none_s = b"N" * 3 + _integer(-1) * 2 + _integer(0)
    dtype += _tuple(_integer(3), _text(order), none_s) + b"b"
    if array.dtype.hasobject:
        content = _list(*[_value(item) for item in array.ravel()])
    else:
        raw = np.ascontiguousarray(array).tobytes()
        content = b"B" + struct.pack("<I", len(raw)) + raw
    empty = _tuple(_name("numpy", "ndarray"), _tuple(_integer(0)), b"C\x01b")
    made = _name("numpy.core.multiarray", "_reconstruct") + empty + b"R"
    shape = _tuple(*[_integer(size) for size in array.shape])
    return made + _tuple(_integer(1), shape, dtype, b"\x89", content) + b"b"


def _index(kind: str, data: dict[str, bytes]) -> bytes:
    module = "pandas.core.indexes." + {"Index": "base", "RangeIndex": "range"}[kind]
    new_index = _name("pandas.core.indexes.base", "_new_Index")
    return new_index + _tuple(_name(module, kind), _dict(data)) + b"R"


def _blocks(columns: dict[str, np.ndarray]) -> list[tuple[bytes, bytes]]:
    """One block per column type: its values and the places of its columns."""
    blocks = []
    for kind in dict.fromkeys(column.dtype for column in columns.values()):
        places = [i for i, column in enumerate(columns.values()) if column.dtype == kind]
        values = np.stack([list(columns.values())[place] for place in places])
        blocks.append((_array(values), _array(np.array(places, dtype=np.int64))))
    return blocks


def pickled_table(columns: dict[str, np.ndarray], *, as_pandas: int = 1) -> bytes:
    """A table as pandas 1 or pandas 2 pickles it."""
    num_rows = len(next(iter(columns.values())))
    names = np.array(list(columns), dtype=object)
    steps = {"start": _integer(0), "stop": _integer(num_rows), "step": _integer(1)}
    axes = _list(
        _index("Index", {"data": _array(names), "name": b"N"}),
        _index("RangeIndex", {"name": b"N", **steps}),
    )
    manager = _name("pandas.core.internals.managers", "BlockManager")
    if as_pandas == 1:
        blocks = [
            _dict({"values": values, "mgr_locs": places}) for values, places in _blocks(columns)
        ]
        layout = _dict({"0.14.1": _dict({"axes": axes, "blocks": _list(*blocks)})})
        manager += b")\x81" + _tuple(axes, _list(), _list(), layout) + b"b"
    else:
        make = _name("pandas._libs.internals", "_unpickle_block")
        blocks = [
            make + _tuple(values, places, _integer(2)) + b"R" for values, places in _blocks(columns)
        ]
        manager += _tuple(_tuple(*blocks), axes) + b"R"
    frame = _name("pandas.core.frame", "DataFrame") + b")\x81"
    state = {"_data" if as_pandas == 1 else "_mgr": manager, "_typ": _text("dataframe")}
    return b"\x80\x03" + frame + _dict(state) + b"b."
