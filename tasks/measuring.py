"""Wall time, CPU time and peak memory of a stage."""

import resource
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from lidarpainter_models.kernels.compile_clock import CompileClock

CLEAR_REFS = Path("/proc/self/clear_refs")
STATUS = Path("/proc/self/status")
RESET_PEAK = "5"
"""Written to `clear_refs`, this starts the peak of the resident set anew (proc(5))."""


@dataclass
class Measurement:
    """What a block took; filled in when the block ends."""

    seconds: float = 0.0
    cpu_seconds: float = 0.0
    """Of all threads of this process, without compiling kernels: a machine does that once."""
    peak_memory_bytes: int = 0
    """Largest resident set of this process while the block ran."""


@contextmanager
def measured() -> Iterator[Measurement]:
    """Measure a block.

    Where the kernel does not let the peak be reset, it is that of the whole process so far.
    """
    measurement = Measurement()
    can_reset = _reset_peak()
    compiling = CompileClock()
    compiling.start()
    started, cpu_started = time.perf_counter(), time.process_time()
    try:
        yield measurement
    finally:
        measurement.seconds = time.perf_counter() - started
        compiling.stop()
        measurement.cpu_seconds = time.process_time() - cpu_started - compiling.cpu_seconds
        measurement.peak_memory_bytes = _peak_bytes() if can_reset else _process_peak_bytes()


def _reset_peak() -> bool:
    try:
        CLEAR_REFS.write_text(RESET_PEAK)
    except OSError:
        return False
    return True


def _peak_bytes() -> int:
    for line in STATUS.read_text().splitlines():
        if line.startswith("VmHWM:"):
            return int(line.split()[1]) * 1024
    return _process_peak_bytes()


def _process_peak_bytes() -> int:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
