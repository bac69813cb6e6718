"""From an error to the cause that the catalog decides by."""

import errno

from catalog.attempts import Cause
from catalog.errors import CatalogError, ConflictError, UnreachableError, disk_error
from lidarpainter_models.errors import (
    BackendError,
    LidarPainterError,
    MissingPackageError,
    TrainingError,
)

NO_ROOM = (errno.ENOSPC, errno.EDQUOT)
OF_THIS_MACHINE = (BackendError, MissingPackageError, TrainingError)
"""Of the library, but not the fault of the input."""
ORCHESTRATION = ("prefect", "httpx", "httpcore")
"""Packages whose errors say that Prefect's server was not there, not that the work is wrong."""
NO_MEMORY = ("can't allocate memory", "out of memory", "not enough memory")
"""How torch says that there is no memory: by a RuntimeError."""
LONGEST_REASON = 500


def cause_of(error: Exception) -> tuple[Cause, str]:
    """Why an attempt ended, and one line about it."""
    cause = _cause(error)
    text = " ".join(str(error).split())[:LONGEST_REASON]
    is_ours = isinstance(error, (LidarPainterError, CatalogError))
    name = type(error).__name__
    return cause, text if is_ours and text else f"{name}: {text}".removesuffix(": ")


def is_storage_away(error: Exception) -> bool:
    """Whether the store cannot be used for now: there is no room, or a bucket does not answer."""
    return disk_error(error) in NO_ROOM or isinstance(error, UnreachableError)


def _cause(error: Exception) -> Cause:
    if isinstance(error, UnreachableError):
        return "store-lost"
    if is_storage_away(error):
        return "disk-full"
    if isinstance(error, MemoryError) or any(words in str(error) for words in NO_MEMORY):
        return "memory"
    if isinstance(error, TimeoutError):
        return "timeout"
    if isinstance(error, (OSError, ConflictError)):
        return "system"
    if type(error).__module__.partition(".")[0] in ORCHESTRATION:
        return "system"
    if isinstance(error, LidarPainterError) and not isinstance(error, OF_THIS_MACHINE):
        return "bad-input"
    return "error"
