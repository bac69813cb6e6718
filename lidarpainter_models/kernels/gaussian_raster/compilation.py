"""How the rasteriser's compiled code is built and when its cache is stale.

numba notices a changed function only in its own file, but these functions call each other across
files. So only the outermost functions are cached, under a name that changes with any source file
here; everything they call is compiled into them.
"""

import hashlib
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba

_ENTRY: dict[str, Any] = {"error_model": "numpy", "fastmath": {"contract"}, "forceinline": True}
# never called from Python
_INNER: dict[str, Any] = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}

EXACT = _ENTRY | _INNER
"""Code on single Gaussians: fused multiply-add, otherwise as written; divisions do not raise."""


def _sources_digest() -> str:
    sources = sorted(Path(__file__).parent.glob("*.py"))
    return hashlib.sha256(b"".join(path.read_bytes() for path in sources)).hexdigest()[:12]


SOURCES = _sources_digest()


def compiled_entry(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile a function with `prange` loops that Python calls; cache it for these sources."""
    function.__qualname__ = f"{function.__qualname__}_{SOURCES}"
    return numba.njit(cache=True, nogil=True, parallel=True, **_ENTRY)(function)


GOLDEN_RATIO = 0.6180339887498949
"""Multiples of it, modulo 1, fill an interval most evenly."""


@numba.njit(**EXACT)
def jump_of(count: int) -> int:
    """A step near the golden ratio of `count` that visits all of `range(count)`, modulo `count`.

    Places that jump through uneven work share it out evenly: sky tiles are empty and road tiles are
    full, near Gaussians reach many tiles and far ones few, so contiguous shares would keep one
    thread waiting for another.
    """
    jump = max(int(count * GOLDEN_RATIO), 1)
    while math.gcd(jump, count) > 1:
        jump += 1
    return jump
