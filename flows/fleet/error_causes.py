"""From an error to the cause that the catalog decides by."""

import errno
from collections.abc import Callable

from catalog.errors import CatalogError, ConflictError, UnreachableError, disk_error
from catalog.retries import Cause
from flows.fleet.flow_runs import is_of_lost_api
from lidarpainter_models.errors import (
    BackendError,
    LidarPainterError,
    MissingPackageError,
    TrainingError,
)

NO_ROOM = (errno.ENOSPC, errno.EDQUOT)
OF_THIS_MACHINE = (BackendError, MissingPackageError, TrainingError)
"""Errors of the library that are not the fault of the input."""
ORCHESTRATION = ("prefect", "httpx", "httpcore")
"""Packages whose errors say that Prefect is amiss, not that the work is wrong."""
NO_MEMORY = ("can't allocate memory", "out of memory", "not enough memory")
"""How torch says that there is no memory: by a RuntimeError."""
LONGEST_REASON = 500


def cause_of(error: Exception) -> tuple[Cause, str]:
    """Why an attempt ended, and one line about it."""
    cause: Cause = next((cause for cause, fits in RULES if fits(error)), "error")
    text = " ".join(str(error).split())[:LONGEST_REASON]
    is_ours = isinstance(error, (LidarPainterError, CatalogError))
    name = type(error).__name__
    return cause, text if is_ours and text else f"{name}: {text}".removesuffix(": ")


def is_storage_away(error: Exception) -> bool:
    """Whether the store cannot be used for now: there is no room, or a bucket does not answer."""
    return disk_error(error) in NO_ROOM or isinstance(error, UnreachableError)


def _is_memory(error: Exception) -> bool:
    return isinstance(error, MemoryError) or any(words in str(error) for words in NO_MEMORY)


def _is_of_system(error: Exception) -> bool:
    is_orchestration = type(error).__module__.partition(".")[0] in ORCHESTRATION
    return is_orchestration or isinstance(error, (OSError, ConflictError))


def _is_bad_input(error: Exception) -> bool:
    return isinstance(error, LidarPainterError) and not isinstance(error, OF_THIS_MACHINE)


RULES: tuple[tuple[Cause, Callable[[Exception], bool]], ...] = (
    ("store-lost", lambda error: isinstance(error, UnreachableError)),
    ("disk-full", is_storage_away),
    ("api-lost", is_of_lost_api),
    ("memory", _is_memory),
    ("timeout", lambda error: isinstance(error, TimeoutError)),
    ("system", _is_of_system),
    ("bad-input", _is_bad_input),
)
"""The first that fits says why."""
