"""Settings of the whole process that must stand before heavy packages are imported.

What the user has set stays as it is.
"""

import ctypes
import os
import tempfile
from pathlib import Path

from tasks.job_limits import usable_cores

PREFECT = {
    "PREFECT_SERVER_EPHEMERAL_STARTUP_TIMEOUT_SECONDS": "120",
    "PREFECT_SERVER_ANALYTICS_ENABLED": "false",
    "PREFECT_CLOUD_ENABLE_ORCHESTRATION_TELEMETRY": "false",
    "DO_NOT_TRACK": "1",
}
THREADS = {
    # spinning OpenMP threads turn shared cores into many times the CPU time
    "OMP_WAIT_POLICY": "passive",
    # numba looks for TBB first and warns where the one it finds is too old
    "NUMBA_THREADING_LAYER_PRIORITY": "omp workqueue tbb",
}
KEPT_BYTES = 32 << 20
"""Largest freed block that the C library keeps for the next use: as far as glibc goes by itself."""
M_TRIM_THRESHOLD, M_MMAP_THRESHOLD, M_ARENA_MAX = -1, -3, -8  # of malloc.h


def prepare_environment(*, log_level: str | None = "CRITICAL") -> None:
    """Set what Prefect, OpenMP and numba read at import, and keep freed memory.

    Without a `log_level` Prefect decides which of its log lines are shown.
    """
    threads = str(usable_cores())
    counts = {"NUMBA_NUM_THREADS": threads, "OMP_NUM_THREADS": threads}
    level = {} if log_level is None else {"PREFECT_LOGGING_LEVEL": log_level}
    for name, value in {**PREFECT, **THREADS, **counts, **level}.items():
        os.environ.setdefault(name, value)
    _keep_freed_memory()
    if not _has_cache_folder():
        # a fresh private folder: compiled code is unpickled, nobody else may put it there
        os.environ.setdefault("NUMBA_CACHE_DIR", tempfile.mkdtemp(prefix="lidarpainter-numba-"))


def _keep_freed_memory() -> None:
    """Let glibc keep blocks up to `KEPT_BYTES` from the start, for all threads in one place.

    It comes to that by itself once such a block was freed (mallopt(3), M_MMAP_THRESHOLD); until
    then every image pays for fresh pages, ten thousand page faults a painted view. What each thread
    keeps for itself no other one can use: a run came to twice its memory. Other C libraries have no
    such settings.
    """
    adjust = getattr(ctypes.CDLL(None), "mallopt", None) if os.name == "posix" else None
    if adjust is not None and not any(name.startswith("MALLOC_") for name in os.environ):
        adjust(M_MMAP_THRESHOLD, KEPT_BYTES)
        adjust(M_TRIM_THRESHOLD, 2 * KEPT_BYTES)
        adjust(M_ARENA_MAX, 1)


def _has_cache_folder() -> bool:
    """Whether numba can keep compiled code beside the sources or in the user's cache."""
    package = Path(__file__).resolve().parents[1] / "lidarpainter_models" / "kernels"
    user = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "numba"
    return _can_write(package / "__pycache__") or _can_write(user)


def _can_write(folder: Path) -> bool:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return True
    except OSError:
        return False
