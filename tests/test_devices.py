"""Memory that was freed, in a process of its own."""

import platform
import subprocess
import sys

import pytest

RESIDENT_MB = """
import os
from pathlib import Path
import numpy as np
from lidarpainter_models.devices import return_freed_memory

def resident_mb():
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGESIZE") / 1e6

held = [np.ones(8000) for _ in range(4000)]
last = np.ones(8000)  # lies above all of them
full_mb = resident_mb()
del held
freed_mb = resident_mb()
return_freed_memory()
print(full_mb - freed_mb, full_mb - resident_mb())
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="how glibc gives memory back")
def test_freed_memory_below_what_is_used_returns_to_the_system():
    run = [sys.executable, "-c", RESIDENT_MB]
    printed = subprocess.run(run, check=True, capture_output=True, text=True).stdout
    by_itself_mb, when_asked_mb = map(float, printed.split())
    assert by_itself_mb < 50
    assert when_asked_mb > 200
