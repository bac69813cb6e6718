"""Folders on a disk: when they were changed, what is there of them, whether they take files."""

import tempfile
from datetime import UTC, datetime
from pathlib import Path

from catalog.errors import StorageError


def changed_at(path: Path) -> datetime:
    """When a file or a folder was last changed; long ago if it is gone."""
    try:
        return datetime.fromtimestamp(path.stat().st_mtime, UTC)
    except FileNotFoundError:
        return datetime.fromtimestamp(0, UTC)


def nearest_existing(path: Path) -> Path:
    """A path, or the first above it that is there."""
    return next(one for one in (path, *path.parents) if one.exists())


def make_writable(folder: Path, what: str) -> None:
    """Make a folder where it is not there, and see that it takes a file.

    Raises:
        StorageError: it cannot be made or written.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder) as probe:
            probe.write(b"-")
    except OSError as error:
        raise StorageError(
            f"{what} {folder} cannot be written: {error.strerror}; expected a folder with room"
        ) from None
