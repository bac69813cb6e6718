"""How the rasteriser's compiled code is built and when its cache is stale.

numba notices a changed function only in its own file, but these functions call each other across
files. So only the outermost functions are cached, under a name that changes with any source file
here; everything they call is compiled into them.
"""

import hashlib
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
