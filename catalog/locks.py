"""Locks between processes that die with their holder.

`flock` on a small file: the kernel drops it when the process ends, however it ends, so a killed
run never blocks the next one. Lock files are left in place: deleting them would let two processes
hold locks on two files of one name.
"""

import fcntl
import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from catalog.errors import storage_errors

POLL_S = 0.2


@contextmanager
def held_lock(path: Path, *, on_wait: Callable[[str], None] | None = None) -> Iterator[bool]:
    """Hold the lock while the block runs; wait for as long as another process holds it.

    `on_wait` is told the holder's process id, once.

    Yields:
        Whether another holder had to be waited for.

    Raises:
        StorageError: the lock file cannot be made.
    """
    descriptor = open_lock(path)
    try:
        waited = _acquire(descriptor, on_wait)
        os.ftruncate(descriptor, 0)
        os.pwrite(descriptor, str(os.getpid()).encode(), 0)
        yield waited
    finally:
        os.close(descriptor)  # closing the only descriptor releases the lock


@contextmanager
def shared_lock(path: Path) -> Iterator[None]:
    """Hold a lock that others may hold too while the block runs; see `is_held`.

    Raises:
        StorageError: the lock file cannot be made.
    """
    descriptor = open_lock(path, os.O_RDONLY)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_SH)
        yield
    finally:
        os.close(descriptor)


def open_lock(path: Path, access: int = os.O_RDWR) -> int:
    """The descriptor of a lock file, made where it is not there.

    Raises:
        StorageError: it cannot be made.
    """
    with storage_errors(f"cannot lock {path}"):
        path.parent.mkdir(parents=True, exist_ok=True)
        return os.open(path, access | os.O_CREAT | os.O_CLOEXEC, 0o644)


def is_held(path: Path) -> bool:
    """Whether any process holds the lock."""
    with suppress(FileNotFoundError), path.open("rb") as file:
        return not _try_acquire(file.fileno())
    return False


def _acquire(descriptor: int, on_wait: Callable[[str], None] | None) -> bool:
    if _try_acquire(descriptor):
        return False
    if on_wait is not None:
        on_wait(os.pread(descriptor, 32, 0).decode(errors="replace") or "unknown")
    # polling, not a blocking flock: Ctrl-C is then answered at once, in any thread
    while not _try_acquire(descriptor):
        time.sleep(POLL_S)
    return True


def _try_acquire(descriptor: int) -> bool:
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True
