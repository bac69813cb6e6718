"""Choose which implementation of a kernel runs.

Every kernel package holds `reference.py` (plain torch, the law), `cpu.py` (numba) and, where it
pays, `cuda.py`. Implementations are imported when first asked for, so nothing is compiled at
import.
"""

from collections.abc import Callable
from importlib import import_module
from importlib.util import find_spec
from typing import Any, Literal, get_args

import torch

from lidarpainter_models.errors import BackendError

Backend = Literal["auto", "reference", "cpu", "cuda"]


def available_backends(kernel: str) -> tuple[str, ...]:
    """The backends of a kernel that can run on this machine."""
    found = [
        backend
        for backend in get_args(Backend)[1:]
        if find_spec(f"lidarpainter_models.kernels.{kernel}.{backend}") is not None
    ]
    if not torch.cuda.is_available() and "cuda" in found:
        found.remove("cuda")
    return tuple(found)


def chosen_backend(backend: Backend, device: torch.device) -> str:
    """The backend by name; `auto` takes cuda for GPU tensors and cpu for others."""
    if backend == "auto":
        return "cuda" if device.type == "cuda" else "cpu"
    return backend


def implementation(
    kernel: str, function: str, backend: Backend, device: torch.device
) -> Callable[..., Any]:
    """The function of a kernel's backend, see `chosen_backend`.

    Raises:
        BackendError: the backend does not exist for this kernel or cannot run here.
    """
    chosen = chosen_backend(backend, device)
    if chosen not in available_backends(kernel):
        raise BackendError(
            f"kernel {kernel!r} has no {chosen!r} backend here "
            f"(available: {', '.join(available_backends(kernel))})"
        )
    return getattr(import_module(f"lidarpainter_models.kernels.{kernel}.{chosen}"), function)
