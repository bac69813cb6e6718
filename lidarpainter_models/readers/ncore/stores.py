"""Read component stores of NCore V4: Zarr hierarchies in a folder, or in an indexed tar archive.

Behind the end of such an archive (`.zarr.itar`) stand a list of its records, as CBOR packed by xz,
and in the last 512 bytes where that list is. Of Zarr, versions 2 and 3, what NCore writes is read:
arrays of plain numbers or bytes, as they are or packed by Blosc. Anything else is refused before it
is decoded, for some codecs of Zarr run what they are given.
"""

import hashlib
import lzma
import math
import re
import struct
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from numcodecs import blosc

from lidarpainter_models.errors import DataError
from lidarpainter_models.readers.source_logs.folder import MAX_FILE_BYTES, SourceFolder

Shape = tuple[int | None, ...]
"""Lengths that an array must have; None stands for any."""
_HEADER, _HEADER_BLOCK, _CBOR_XZ = struct.Struct("<4sIQI"), 512, 1
_MAX_LIST_BYTES = 1 << 24
"""Of a list of records: some 300 000."""
_BLOSC_HEADER = struct.Struct("<4xIII")
_KINDS = re.compile(r"[<|]([iuf][1248]|b1|S[1-9][0-9]{0,8})")


class ComponentStore(SourceFolder):
    """A store: a folder of records, or an archive of them."""

    def __init__(self, path: Path) -> None:
        """Open a store; of an archive the list of records is read.

        Raises:
            DataError: it cannot be read, or is no such archive.
        """
        super().__init__(path)
        self._records = self._listed() if path.is_file() else None

    def has(self, name: str) -> bool:
        """Whether there is a record of that name."""
        return (self.root / name).is_file() if self._records is None else name in self._records

    def children(self, path: str) -> list[str]:
        """Names of the groups and arrays below a group, sorted."""
        if self._records is not None:
            start = len(path) + 1
            names = {
                name[start:].split("/")[0] for name in self._records if name[:start] == f"{path}/"
            }
        else:
            folder = self.root / path
            names = {one.name for one in folder.iterdir()} if folder.is_dir() else set()
        return sorted(name for name in names if name[:1] != "." and name != "zarr.json")

    def read_bytes(self, name: str) -> bytes:
        """The content of one record.

        Raises:
            DataError: there is none, or it cannot be read.
        """
        if self._records is None:
            return super().read_bytes(name)
        if name not in self._records:
            raise DataError(f"{self.root / name}: the record is missing")
        content = self._range(*self._records[name], name)
        self._digests[name] = hashlib.sha256(content).hexdigest()
        return content

    def attributes(self, path: str) -> dict[str, Any]:
        """The attributes of a group.

        Raises:
            DataError: there are none.
        """
        start = f"{path}/" if path else ""
        if not self.has(f"{start}zarr.json"):
            found = self.read_json(f"{start}.zattrs", dict)
        else:
            found = self.read_json(f"{start}zarr.json", dict).get("attributes")
        if not isinstance(found, dict):
            raise DataError(f"{self.root}/{path}: no attributes, expected some")
        return found

    def array(self, path: str, shape: Shape | None = None) -> np.ndarray:
        """An array, whose shape must be as stated where it is.

        Raises:
            DataError: it is not there, damaged, or packed in another way than NCore's.
        """
        where, is_third = f"{self.root}/{path}", self.has(f"{path}/zarr.json")
        stated = self.read_json(f"{path}/{'zarr.json' if is_third else '.zarray'}", dict)
        try:
            layout = _as_second(stated) if is_third else stated
            full, chunk, kind, is_packed = _layout(layout)
            start, between = layout.get("start", ""), layout.get("dimension_separator", ".")
        except (LookupError, TypeError, ValueError, AttributeError) as error:
            raise DataError(
                f"{where}: expected numbers or bytes, plain or packed by Blosc ({error!r:.80})"
            ) from None
        chunk_bytes = kind.itemsize * math.prod(chunk)
        if max(kind.itemsize * math.prod(full), chunk_bytes) > MAX_FILE_BYTES:
            raise DataError(f"{where}: {full} values, expected at most {MAX_FILE_BYTES} bytes")
        if shape is not None and not fits(full, shape):
            raise DataError(f"{where}: {full} values, expected {shape}")
        array = np.empty(full, kind)
        for place in product(*(range(math.ceil(n / c)) for n, c in zip(full, chunk, strict=True))):
            name = between.join([*start, *map(str, place)]) or "0"
            raw = self.read_bytes(f"{path}/{name}")
            raw = _unpacked(raw, chunk_bytes, where) if is_packed else raw
            if len(raw) != chunk_bytes:
                raise DataError(f"{where}: {len(raw)} bytes of a chunk, expected {chunk_bytes}")
            target = tuple(slice(i * c, (i + 1) * c) for i, c in zip(place, chunk, strict=True))
            inside = tuple(slice(0, length) for length in array[target].shape)
            array[target] = np.frombuffer(raw, kind).reshape(chunk)[inside]
        return array

    def _listed(self) -> dict[str, tuple[int, int]]:
        """Where the records of an archive begin and how long they are, by name."""
        size = self.root.stat().st_size
        header = self._range(max(size - _HEADER_BLOCK, 0), _HEADER.size, "its header")
        magic, kind, start, length = _HEADER.unpack(header)
        if magic != b"itar" or kind != _CBOR_XZ:
            raise DataError(f"{self.root}: not an indexed tar archive of NCore V4")
        packed = self._range(start, length, "its list of records")
        try:
            unpacker = lzma.LZMADecompressor(lzma.FORMAT_XZ, memlimit=MAX_FILE_BYTES)
            table, _ = _cbor(unpacker.decompress(packed, _MAX_LIST_BYTES), 0)
            names, starts, lengths = (table[name] for name in ("items", "offset_datas", "sizes"))
            found = dict(zip(names, zip(starts, lengths, strict=True), strict=True))
        except (lzma.LZMAError, LookupError, TypeError, ValueError, RecursionError) as error:
            what = f"its list of records is damaged ({error!r:.80})"
            raise DataError(f"{self.root}: {what}") from None
        are_places = all(type(number) is int for number in (*starts, *lengths))
        if not (unpacker.eof and are_places and all(type(name) is str for name in names)):
            raise DataError(f"{self.root}: its list of records is damaged or too long")
        return found

    def _range(self, start: int, length: int, what: str) -> bytes:
        try:
            with self.root.open("rb") as file:
                size = file.seek(0, 2)
                is_inside = start + length <= size and length <= MAX_FILE_BYTES
                content = file.read(length) if is_inside and file.seek(start) == start else None
        except OSError as error:
            raise DataError(f"{self.root}: cannot be read ({error.strerror})") from None
        if content is None:
            raise DataError(
                f"{self.root}: {what} has {length} bytes at {start} of {size}, expected at most "
                f"{MAX_FILE_BYTES} within the file"
            )
        return content


def fits(shape: tuple[int, ...], expected: Shape) -> bool:
    """Whether a shape is as expected."""
    return len(shape) == len(expected) and all(
        wanted in (None, length) for length, wanted in zip(shape, expected, strict=True)
    )


def _layout(
    stated: dict[str, Any],
) -> tuple[tuple[int, ...], tuple[int, ...], np.dtype, bool]:
    """Shape, shape of a chunk, type of values, and whether chunks are packed."""
    packed, kind = stated["compressor"], stated["dtype"]
    if (packed and packed["id"] != "blosc") or stated["filters"] or stated["order"] != "C":
        raise ValueError(f"packed by {packed}, {stated['filters']}")
    if not _KINDS.fullmatch(kind) or stated.get("dimension_separator", ".") not in (".", "/"):
        raise ValueError(f"values of {kind}")
    shape, chunk = tuple(stated["shape"]), tuple(stated["chunks"])
    if not all(type(length) is int and 0 <= length < 2**31 for length in (*shape, *chunk)):
        raise ValueError("lengths that are none")
    if len(shape) != len(chunk) or 0 in chunk:
        raise ValueError(f"chunks {chunk} of {shape}")
    return shape, chunk, np.dtype(kind), bool(packed)


def _as_second(third: dict[str, Any]) -> dict[str, Any]:
    """What Zarr version 3 says of an array, in the words of version 2."""
    plain, *packed = third["codecs"]
    match = re.fullmatch(r"(int|uint|float)(8|16|32|64)|bool", third["data_type"])
    is_little = plain.get("configuration", {}).get("endian", "little") == "little"
    keys = third["chunk_key_encoding"]
    is_plain = is_little and (plain["name"], keys["name"]) == ("bytes", "default")
    if match is None or not is_plain:
        raise ValueError(f"{third['data_type']}, codec {plain}, keys {keys}")
    kind, bits = match.groups()
    return {
        "shape": third["shape"],
        "chunks": third["chunk_grid"]["configuration"]["chunk_shape"],
        "dtype": f"<{kind[0]}{int(bits) // 8}" if kind else "|b1",
        "compressor": {"id": "/".join(codec["name"] for codec in packed)} if packed else None,
        "filters": None,
        "order": "C",
        "dimension_separator": keys["configuration"]["separator"],
        "start": "c",
    }


def _unpacked(raw: bytes, num_bytes: int, where: str) -> bytes:
    """What Blosc has packed, if its header says that it is as long as it must be."""
    try:
        stated_bytes, _, packed_bytes = _BLOSC_HEADER.unpack_from(raw)
        is_sound = (stated_bytes, packed_bytes) == (num_bytes, len(raw))
        content: bytes = blosc.decompress(raw) if is_sound else b""
    except (struct.error, RuntimeError, ValueError):
        content = b""
    if len(content) != num_bytes:
        raise DataError(f"{where}: a chunk cannot be unpacked, expected {num_bytes} bytes by Blosc")
    return content


def _cbor(content: bytes, at: int) -> tuple[Any, int]:
    """A whole number, a text, or a list or map of such (RFC 8949), and where it ends."""
    kind, number = content[at] >> 5, content[at] & 31
    at += 1
    if number >= 24:
        end = at + (1 << (number - 24))
        number, at = int.from_bytes(content[at:end], "big"), end
    if kind == 0:
        return number, at
    if kind == 3:
        return content[at : at + number].decode(), at + number
    if kind not in (4, 5):
        raise ValueError(f"a value of kind {kind}")
    items = []
    for _ in range(number * (kind - 3)):  # a map has two for each entry
        item, at = _cbor(content, at)
        items.append(item)
    return (items if kind == 4 else dict(zip(items[::2], items[1::2], strict=True))), at
