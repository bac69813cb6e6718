"""Files that are there whole or not at all."""

import errno
import hashlib
import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from lidarpainter_models.errors import LidarPainterError, WriteError


@contextmanager
def storage_errors(path: Path) -> Iterator[None]:
    """Turn a failed write or read below `path` into a one-line `WriteError`."""
    try:
        yield
    except OSError as error:
        if isinstance(error, LidarPainterError):
            raise
        reason = error.strerror or str(error)
        hint = "; free some space" if error.errno in (errno.ENOSPC, errno.EDQUOT) else ""
        raise WriteError(f"{path}: cannot be written: {reason}{hint}") from error


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """Give a path beside `path` to write to, then rename it there; an older file stays till then.

    Raises:
        WriteError: the disk refuses.
    """
    aside = path.with_name(f".{path.name}.{secrets.token_hex(4)}")
    with storage_errors(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            yield aside
            sync(aside)  # the name must not reach the disk before the bytes do
            aside.replace(path)
        except BaseException:
            with suppress(OSError):
                aside.unlink()
            raise


def write_whole(path: Path, content: bytes) -> None:
    """Write a file aside and rename it; an older file stays if that fails.

    Raises:
        WriteError: the disk refuses.
    """
    with whole_file(path) as aside:
        aside.write_bytes(content)


def sync(path: Path) -> None:
    """Force a file or the names in a folder to disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def sha256_of(path: Path) -> str:
    """The SHA-256 of a file; 64 hexadecimal digits."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
