"""Choose which implementation of a kernel runs.

Every kernel package holds `reference.py` (plain torch, the law), `cpu.py` (numba) and, where it
pays, `cuda.py`. Implementations are imported when first asked for, so nothing is compiled at
import.
"""

from collections.abc import Callable
from functools import cache
from importlib import import_module
from importlib.util import find_spec
from typing import Any, Literal, get_args

import torch
from torch import Tensor

from lidarpainter_models.errors import BackendError

Backend = Literal["auto", "reference", "cpu", "cuda"]


@cache
def _written_backends(kernel: str) -> tuple[str, ...]:
    return tuple(
        backend
        for backend in get_args(Backend)[1:]
        if find_spec(f"lidarpainter_models.kernels.{kernel}.{backend}") is not None
    )


def available_backends(kernel: str) -> tuple[str, ...]:
    """The backends of a kernel that can run on this machine."""
    written = _written_backends(kernel)
    if "cuda" in written and not torch.cuda.is_available():
        return tuple(backend for backend in written if backend != "cuda")
    return written


def implementation(
    kernel: str, function: str, backend: Backend, device: torch.device
) -> Callable[..., Any]:
    """The function of a kernel's backend.

    `auto` takes numba on the CPU, on a GPU cuda where it is written, elsewhere the plain reference.

    Raises:
        BackendError: the backend does not exist for this kernel or cannot run here.
    """
    found = available_backends(kernel)
    chosen: str = backend
    if backend == "auto":
        fast = "cuda" if device.type == "cuda" else "cpu"
        is_home = device.type in ("cpu", "cuda")
        chosen = fast if is_home and fast in found else "reference"
    if chosen not in found:
        raise BackendError(
            f"kernel {kernel!r} has no {chosen!r} backend here (available: {', '.join(found)})"
        )
    if chosen == "cpu" and device.type != "cpu":
        raise BackendError(f"the numba {kernel} runs on the CPU, got a tensor on {device}")
    return getattr(import_module(f"lidarpainter_models.kernels.{kernel}.{chosen}"), function)


def float32_backend(kernel: str, backend: Backend, like: Tensor) -> Backend:
    """The backend of a kernel whose numba version takes float32 alone, for such numbers.

    Raises:
        BackendError: numba was asked for another kind of numbers.
    """
    if like.dtype == torch.float32:
        return backend
    if backend == "cpu":
        raise BackendError(f"the numba {kernel} takes float32, got {like.dtype}")
    return "reference" if backend == "auto" else backend
