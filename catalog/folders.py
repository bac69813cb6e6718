"""Folders on a disk: where the user's are, when they were changed, whether they take files."""

import os
import tempfile
from datetime import UTC, datetime
from pathlib import Path

from catalog.errors import CatalogError, StorageError

CACHE_ENVIRONMENT = "LIDARPAINTER_CACHE"
DEFAULT_CACHE = "~/.cache/lidarpainter"


def home_folder() -> Path | None:
    """The user's home folder; None where `HOME` is not set and the user has no name."""
    try:
        return Path.home()
    except RuntimeError:
        return None


def expanded(path: str) -> Path:
    """A path as an absolute one, with the home folder in place of a leading `~`.

    Raises:
        CatalogError: there is no home folder.
    """
    try:
        return Path(path).expanduser().absolute()
    except RuntimeError:
        raise CatalogError(f"{path}: there is no home folder, expected HOME to be set") from None


def cache_folder() -> Path:
    """The folder in which this machine mirrors buckets.

    Raises:
        CatalogError: it is in the home folder, and there is none.
    """
    return expanded(os.environ.get(CACHE_ENVIRONMENT) or DEFAULT_CACHE)


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
