"""Read the bundle of anybody: a zip from outside, and the text in it, believed in nothing.

Whatever a zip claims, no more bytes come out of a member than asked for, and names lead nowhere. A
damaged zip is refused as a whole, a damaged member when it is read; each in one line.
"""

import json
import stat
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from jaxtyping import Float

from lidarpainter_models.errors import DataError, LidarPainterError

MOST_MEMBERS = 20_000
MOST_BYTES = 64 * 2**30
"""Of all members together, as they say themselves."""
MOST_RATIO = 200
"""Text is seldom compressed to less than a hundredth; a bomb is, to less than a thousandth."""
MOST_DEPTH = 20
"""Of YAML: lists in lists, tables in tables."""
MOST_JSON_BYTES, MOST_YAML_BYTES, MOST_XML_BYTES = 256 * 2**20, 2**20, 64 * 2**20
_ENCRYPTED = 1


@dataclass(frozen=True, kw_only=True, eq=False)
class OpenedBundle:
    """A zip whose list of members makes sense."""

    path: Path
    packed: zipfile.ZipFile
    members: dict[str, zipfile.ZipInfo]
    """Files by name, in the order in which they lie in the zip."""

    def __contains__(self, name: str) -> bool:
        return name in self.members

    def read(self, name: str, most_bytes: int) -> bytes:
        """All bytes of a member.

        Raises:
            DataError: it is not there, is damaged or compressed in a strange way, or is larger.
        """
        if name not in self.members:
            raise DataError(f"{name} is missing")
        try:
            with self.packed.open(self.members[name]) as file:
                content = file.read(most_bytes + 1)
        except (zipfile.BadZipFile, zlib.error, EOFError, OSError, NotImplementedError) as error:
            raise DataError(f"{name} cannot be read: {error}") from None
        if len(content) > most_bytes:
            raise DataError(f"{name} is larger than {most_bytes >> 20} MB")
        return content

    def json(self, name: str) -> Any:  # noqa: ANN401  any JSON value
        """The value of a member of JSON.

        Raises:
            DataError: it cannot be read or is no JSON.
        """
        content = self.read(name, MOST_JSON_BYTES)
        try:
            return json.loads(content, parse_constant=_no_number)
        except (ValueError, RecursionError) as error:
            raise DataError(f"{name} is no JSON: {error}") from None

    def yaml(self, name: str) -> Any:  # noqa: ANN401  any value of YAML
        """The value of a member of YAML; aliases, by which a short text grows, are refused.

        Raises:
            DataError: it cannot be read or is no plain YAML.
        """
        import yaml

        content = self.read(name, MOST_YAML_BYTES)
        depth = 0
        try:
            for event in yaml.parse(content):  # lazily: what is deep takes a parser very long
                depth += isinstance(event, yaml.CollectionStartEvent)
                depth -= isinstance(event, yaml.CollectionEndEvent)
                if isinstance(event, yaml.AliasEvent) or depth > MOST_DEPTH:
                    raise DataError(f"{name} is no YAML of plain values: aliases, or too deep")
            return yaml.safe_load(content)
        except (yaml.YAMLError, ValueError, RecursionError) as error:
            if isinstance(error, DataError):
                raise
            raise DataError(f"{name} is no YAML: {' '.join(str(error).split())}") from None


@contextmanager
def opened_bundle(path: Path) -> Iterator[OpenedBundle]:
    """Open a bundle.

    Raises:
        DataError: it is no zip, or one whose list of members is made to do harm.
    """
    if not path.is_file():
        raise DataError(f"{path} is not there: expected a bundle, a .usdz file")
    try:
        with zipfile.ZipFile(path) as packed:
            members = packed.infolist()
            _check_members(path, members)
            in_order = sorted(members, key=lambda one: one.header_offset)
            files = {one.filename: one for one in in_order if not one.is_dir()}
            yield OpenedBundle(path=path, packed=packed, members=files)
    except LidarPainterError:
        raise
    except (zipfile.BadZipFile, OSError, ValueError, NotImplementedError) as error:
        raise DataError(f"{path}: no zip that can be read ({error})") from None


def _check_members(path: Path, members: list[zipfile.ZipInfo]) -> None:
    """Refuse lists of members that no writer of bundles makes."""
    if len(members) > MOST_MEMBERS:
        raise DataError(f"{path}: {len(members)} members, expected at most {MOST_MEMBERS}")
    names = [one.filename for one in members]
    if len(set(names)) < len(names):
        raise DataError(f"{path}: two members have one name")
    for one in members:
        _check_member(path, one)
    if sum(one.file_size for one in members) > MOST_BYTES:
        raise DataError(f"{path}: would grow to more than {MOST_BYTES >> 30} GB")
    by_place = sorted(members, key=lambda one: one.header_offset)
    for first, second in pairwise(by_place):
        if first.header_offset + first.compress_size > second.header_offset:
            raise DataError(f"{path}: members lie over one another: a zip bomb")


def _check_member(path: Path, member: zipfile.ZipInfo) -> None:
    """Refuse a name that leads out of the zip, a link, a secret, a bomb."""
    name = member.filename
    parts = PurePosixPath(name).parts
    if not parts or parts[0] == "/" or ".." in parts or set("\\:\0") & set(name):
        raise DataError(f"{path}: a member is named {name[:80]!r}, which leads outside")
    if stat.S_ISLNK(member.external_attr >> 16) or member.flag_bits & _ENCRYPTED:
        raise DataError(f"{path}: {name[:80]!r} is a link or encrypted")
    if member.file_size > MOST_RATIO * max(member.compress_size, 1) + 1000:
        raise DataError(
            f"{path}: {name[:80]!r} would grow from {member.compress_size} to "
            f"{member.file_size} bytes: a zip bomb"
        )


def part(value: Any, *keys: str | int) -> Any:  # noqa: ANN401  any JSON value
    """What lies below some keys of a JSON value.

    Raises:
        DataError: one of the keys is not there.
    """
    for place, key in enumerate(keys):
        is_there = (isinstance(value, dict) and key in value) or (
            isinstance(value, list) and isinstance(key, int) and -len(value) <= key < len(value)
        )
        if not is_there:
            raise DataError(f"{'.'.join(map(str, keys[: place + 1]))} is missing")
        value = value[key]
    return value


def numbers(value: Any, name: str, *shape: int) -> Float[np.ndarray, "..."]:  # noqa: ANN401
    """A JSON value as finite numbers of a shape; -1 stands for any count.

    Raises:
        DataError: it has another shape, or holds what is no number.
    """
    try:
        array = np.asarray(value, dtype=float)
    except (ValueError, TypeError, OverflowError):
        raise DataError(f"{name}: expected {_words(shape)} numbers") from None
    if array.size == 0 and shape[0] == -1:
        array = array.reshape(0, *shape[1:])
    fits = array.ndim == len(shape) and all(
        wanted in (-1, have) for wanted, have in zip(shape, array.shape, strict=True)
    )
    if not fits or not np.isfinite(array).all():
        raise DataError(f"{name}: expected {_words(shape)} finite numbers")
    return array


def _words(shape: tuple[int, ...]) -> str:
    return " x ".join("n" if count == -1 else str(count) for count in shape)


def _no_number(word: str) -> float:
    raise ValueError(f"{word} is no number of JSON")
