"""The sign of life of a worker, given from a thread while its main thread computes.

A thread cannot stop a kernel: where the work must not go on, the process ends. What was computed so
far stays in the store, and whoever goes on finds it.
"""

import os
import threading
import time
from collections.abc import Callable
from contextvars import copy_context
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from catalog.errors import StorageError
from catalog.leases import BEATS, Lease, LeaseLostError, Leases
from lidarpainter_models.kernels.compile_clock import CompileClock

STATM = Path("/proc/self/statm")
RESIDENT = 1
"""Field of it, in pages (proc(5))."""


class Heartbeat:
    """Renews a lease while a block runs."""

    def __init__(
        self,
        leases: Leases,
        lease: Lease,
        *,
        limit_s: float | None,
        on_lost: Callable[[], object],
        on_late: Callable[[], object],
    ) -> None:
        """`on_lost` is called in the thread when the lease is no longer this worker's.

        `on_late` is called likewise when the block takes longer than `limit_s`, which None allows.
        """
        self.lease = lease
        self.peak_memory_bytes = 0
        """Largest that a beat has seen."""
        self._leases = leases
        self._limit_s = limit_s
        self._on_lost = on_lost
        self._on_late = on_late
        self._began, self._cpu_began = time.monotonic(), time.process_time()
        self._compiling = CompileClock()
        self._over = threading.Event()
        run = copy_context().run  # what it says is about the same
        self._thread = threading.Thread(target=run, args=(self._beat,), daemon=True)

    def __enter__(self) -> Self:
        """Start to beat."""
        self._compiling.start()
        self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Stop; the lease is as the last beat left it."""
        self._over.set()
        self._thread.join()
        self._compiling.stop()

    def took(self) -> dict[str, Any]:
        """What the block has taken so far: the fields of an `Ending`."""
        return {
            "seconds": time.monotonic() - self._began,
            "cpu_seconds": time.process_time() - self._cpu_began,
            "compile_seconds": self._compiling.cpu_seconds,
            "peak_memory_bytes": max(self.peak_memory_bytes, resident_bytes()),
        }

    def _beat(self) -> None:
        pause_s = self._leases.time_to_live_s / BEATS
        while not self._over.wait(pause_s):
            took = self.took()
            self.peak_memory_bytes = took["peak_memory_bytes"]
            facts = {"cpu_seconds": took["cpu_seconds"], "memory_bytes": self.peak_memory_bytes}
            try:
                self.lease = self._leases.renew(self.lease, facts)
            except LeaseLostError:
                self._on_lost()
                return
            except StorageError:  # a full disk: the next beat may get through
                continue
            if self._limit_s is not None and took["seconds"] > self._limit_s:
                self._on_late()
                return


def resident_bytes() -> int:
    """Memory that this process has now."""
    try:
        pages = int(STATM.read_text("ascii").split()[RESIDENT])
    except OSError:
        return 0
    return pages * os.sysconf("SC_PAGE_SIZE")
