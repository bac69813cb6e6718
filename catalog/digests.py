"""Digests: one name for the same thing, whoever computes it and whenever.

A digest is the first 32 hexadecimal digits (128 bits) of a SHA-256. Configurations are hashed in
one canonical JSON form; what has no such form is refused, never hashed by its address or left out.
"""

import hashlib
import json
import math
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from enum import Enum
from pathlib import Path
from typing import Any

from catalog.errors import IdentityError

DIGEST_LENGTH = 32
_BLOCK_BYTES = 1 << 20


def digest_text(text: str) -> str:
    """Digest of a text."""
    return hashlib.sha256(text.encode()).hexdigest()[:DIGEST_LENGTH]


def digest_file(path: Path) -> str:
    """The full SHA-256 of a file's bytes, 64 hexadecimal digits."""
    sha = hashlib.sha256()
    with path.open("rb") as file:
        while block := file.read(_BLOCK_BYTES):
            sha.update(block)
    return sha.hexdigest()


def file_facts(path: Path) -> dict[str, Any]:
    """What manifests and listings hold of a file: `num_bytes` and `sha256`."""
    return {"num_bytes": path.stat().st_size, "sha256": digest_file(path)}


def canonical_json(value: Any) -> str:  # noqa: ANN401 - any configuration
    """The one JSON text of a configuration: sorted keys, no spaces, finite numbers.

    Raises:
        IdentityError: the value holds something without a canonical form.
    """
    return json.dumps(
        plain(value), sort_keys=True, separators=(",", ":"), ensure_ascii=False, allow_nan=False
    )


def plain(value: Any, where: str = "value") -> Any:  # noqa: ANN401 - any configuration
    """A configuration as JSON types: dataclasses by field, tuples as lists, paths as text.

    Raises:
        IdentityError: the value holds something without a canonical form.
    """
    if isinstance(value, Enum):
        return plain(value.value, where)
    if value is None or isinstance(value, (bool, int, str)):
        return value
    if isinstance(value, float):
        if not math.isfinite(value):
            raise IdentityError(f"{where} is {value}: only finite numbers have a canonical form")
        return value
    if isinstance(value, Path):
        return value.as_posix()
    return _plain_container(value, where)


def _plain_container(value: Any, where: str) -> Any:  # noqa: ANN401 - any configuration
    if is_dataclass(value) and not isinstance(value, type):
        return {
            field.name: plain(getattr(value, field.name), f"{where}.{field.name}")
            for field in fields(value)
        }
    if isinstance(value, Mapping):
        if not all(isinstance(key, str) for key in value):
            raise IdentityError(f"{where} has keys that are not text")
        return {key: plain(item, f"{where}.{key}") for key, item in value.items()}
    if isinstance(value, (set, frozenset)):
        return sorted(plain(item, where) for item in value)
    if isinstance(value, (list, tuple)):
        return [plain(item, f"{where}[{index}]") for index, item in enumerate(value)]
    if model_fields := getattr(type(value), "model_fields", None):  # a pydantic model
        return plain({name: getattr(value, name) for name in model_fields}, where)
    raise IdentityError(f"{where} is a {type(value).__name__}, which has no canonical form")
