"""Damage files as accidents and attackers do.

    damage = damaged_bytes(content, rng)  # any file
    damage = damaged_json(content, rng)  # a JSON file: its values, or its bytes

All damage is drawn from a `numpy.random.Generator`: equal seeds give equal files. What readers make
of it is judged in fuzzing.py.
"""

import copy
import json
import struct
from dataclasses import dataclass
from typing import Any

import numpy as np

HUGE_LENGTHS = (0x7F, 0xFFFF, 2**31 - 1, 2**31, 2**32 - 1, 2**63 - 1, 2**63, 2**64 - 1)
STRANGE_FLOATS = (float("nan"), float("inf"), float("-inf"), 3e38, -3e38, 1e-45, 0.0)
STRANGE_NUMBERS = (
    *(float("nan"), float("inf"), float("-inf"), 1e308, -1e308, 5e-324),
    *(0, -1, 2**31, 2**53 + 1, 2**63, -(2**63) - 1, 2**64, 10**30, 10**400, 0.5, -0.0),
)
OTHER_TYPES: tuple[Any, ...] = (
    None,
    True,
    False,
    7,
    1.5,
    "",
    "text",
    [],
    {},
    [[]],
    [None],
    {"a": {"b": []}},
)
TRAVERSALS = (
    *("../../../../etc/passwd", "/etc/passwd", "..", ".", "/", "~/x", "samples/../../x"),
    *("a\\..\\..\\b", "C:\\x", "file:///etc/passwd", "name\x00.jpg", "\ud800", "x" * 5000),
    *("samples/" * 300, "-rf", "line\nbreak", "\u202egpj", "/dev/zero", "/proc/self/mem"),
)
_NESTED = '"many brackets stand here"'


@dataclass(frozen=True)
class Damage:
    """A damaged file and what was done to it."""

    content: bytes
    description: str


def damaged_bytes(content, rng):
    """One damage that needs no knowledge of the format."""
    ways = (_flip, _truncate, _splice, _huge_length, _strange_float, _fill)
    return ways[rng.integers(len(ways))](bytearray(content), rng)


def damaged_json(content, rng):
    """One damage to the values of a JSON file; every fifth time to its bytes."""
    if rng.random() < 0.2:
        return damaged_bytes(content, rng)
    value = json.loads(content)
    ways = (
        *(_other_type, _strange_number, _without_key, _twice),
        *(_unknown_token, _known_token, _traversal, _deep),
    )
    value, description = ways[rng.integers(len(ways))](value, rng)
    depth = int(rng.choice([50, 2000, 200_000]))
    nested = b"[" * depth + b"]" * depth
    return Damage(json.dumps(value).replace(_NESTED, nested.decode()).encode(), description)


# --- bytes


def _flip(content, rng):
    positions = rng.integers(max(len(content), 1), size=rng.integers(1, 9)).tolist()
    for position in positions:
        if content:
            content[position] ^= 1 << int(rng.integers(8))
    return Damage(bytes(content), f"bits flipped at {positions}")


def _truncate(content, rng):
    kept = int(rng.choice([0, 1, len(content) - 1, rng.integers(max(len(content), 1))]))
    return Damage(bytes(content[: max(kept, 0)]), f"cut to {kept} bytes")


def _splice(content, rng):
    """A slice removed, repeated, or moved over another place."""
    start, stop, place = sorted(rng.integers(len(content) + 1, size=3).tolist())
    part = content[start:stop]
    way = ("removed", "repeated", "copied")[rng.integers(3)]
    if way == "removed":
        del content[start:stop]
    elif way == "repeated":
        content[stop:stop] = part
    else:
        content[place : place + len(part)] = part
    return Damage(bytes(content), f"bytes {start} to {stop} {way}")


def _huge_length(content, rng):
    """An integer of 1 to 8 bytes that, read as a length or an offset, reaches beyond the file."""
    number = int(rng.choice(np.array(HUGE_LENGTHS, dtype=object)))
    size = int(rng.choice([2, 4, 8]))
    order = ("little", "big")[rng.integers(2)]
    place = int(rng.integers(max(len(content) - size, 0) + 1))
    content[place : place + size] = (number % 256**size).to_bytes(size, order)
    return Damage(bytes(content), f"{number} in {size} {order}-endian bytes at {place}")


def _strange_float(content, rng):
    number = STRANGE_FLOATS[rng.integers(len(STRANGE_FLOATS))]
    packed = struct.pack(("<f", "<d", ">f", ">d")[rng.integers(4)], number)
    place = int(rng.integers(max(len(content) - len(packed), 0) + 1)) // len(packed) * len(packed)
    content[place : place + len(packed)] = packed
    return Damage(bytes(content), f"{number} in {len(packed)} bytes at {place}")


def _fill(content, rng):
    start, stop = sorted(rng.integers(len(content) + 1, size=2).tolist())
    byte = int(rng.choice([0, 255, rng.integers(256)]))
    content[start:stop] = bytes([byte]) * (stop - start)
    return Damage(bytes(content), f"bytes {start} to {stop} set to {byte}")


# --- values of a JSON document


def _places(value, rng, wanted):
    """A random (container, key) whose value `wanted` accepts, or None; walks down, many tries."""
    for _ in range(40):
        container, key = None, None
        node = value
        while isinstance(node, dict | list) and node and (container is None or rng.random() < 0.9):
            keys = list(node) if isinstance(node, dict) else range(len(node))
            container, key = node, keys[rng.integers(len(keys))]
            node = container[key]
        if container is not None and wanted(node):
            return container, key
    return None


def _replaced(value, rng, wanted, new, what):
    place = _places(value, rng, wanted)
    if place is None:
        return new, f"the whole document is {what}"
    container, key = place
    container[key] = new
    return value, f"{key!r} is {what}"


def _other_type(value, rng):
    new = copy.deepcopy(OTHER_TYPES[rng.integers(len(OTHER_TYPES))])
    return _replaced(value, rng, lambda _: True, new, f"now {new!r}")


def _strange_number(value, rng):
    new = STRANGE_NUMBERS[rng.integers(len(STRANGE_NUMBERS))]
    return _replaced(value, rng, _is_number, new, f"now {str(new)[:20]}")


def _without_key(value, rng):
    place = _places(value, rng, lambda _: True)
    if place is None:
        return None, "the whole document is null"
    container, key = place
    del container[key]
    return value, f"{key!r} is gone"


def _twice(value, rng):
    """An entry of a list stands twice: duplicate tokens, a number too many."""
    place = _places(value, rng, lambda node: isinstance(node, dict | int | float | list))
    if place is None or not isinstance(place[0], list):
        return [value, value], "the whole document stands twice"
    container, key = place
    container.insert(int(rng.integers(len(container) + 1)), copy.deepcopy(container[key]))
    return value, f"entry {key} stands twice"


def _unknown_token(value, rng):
    new = rng.bytes(16).hex()
    return _replaced(value, rng, lambda node: isinstance(node, str), new, "a token nothing has")


def _known_token(value, rng):
    """A text of one row in the place of another's: crossed links and cycles."""
    source = _places(value, rng, lambda node: isinstance(node, str))
    new = source[0][source[1]] if source else "text"
    return _replaced(value, rng, lambda node: isinstance(node, str), new, "another row's text")


def _traversal(value, rng):
    new = TRAVERSALS[rng.integers(len(TRAVERSALS))]
    return _replaced(value, rng, lambda node: isinstance(node, str), new, f"now {new[:30]!r}")


def _deep(value, rng):
    """Nested so that a parser which calls itself runs out of stack."""
    return _replaced(value, rng, lambda _: True, json.loads(_NESTED), "nested deeply")


def _is_number(value):
    return isinstance(value, int | float) and not isinstance(value, bool)
