"""Choose which implementation of a kernel runs.

Every kernel package holds `reference.py` (plain torch, the law), `cpu.py` (numba) and, where it
pays, `triton.py` for a GPU; the rasteriser also has `cuda.py`, an adapter to gsplat.
Implementations are imported when first asked for, so nothing is compiled at import. A run may ask
for plain torch on the CPU too, the path of a GPU, or for gsplat (`kernels_chosen`).
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from functools import cache
from importlib import import_module
from importlib.util import find_spec
from typing import Any, Literal, get_args

import torch

from lidarpainter_models.devices import KernelChoice
from lidarpainter_models.errors import BackendError, ConfigError
from lidarpainter_models.kernels.gpu_packages import is_interpreting, why_no_gsplat, why_no_triton

Backend = Literal["auto", "reference", "cpu", "cuda", "triton"]
FASTEST = {"cpu": ("cpu",), "cuda": ("triton",)}
"""The backends that `auto` tries on each device before the plain reference."""
RASTERISER = "gaussian_raster"
"""Its reference is for tests alone, far too slow to fit with."""

_choice: ContextVar[KernelChoice] = ContextVar("kernel choice", default="auto")


@contextmanager
def kernels_chosen(choice: KernelChoice) -> Iterator[None]:
    """While this lasts, `auto` follows the choice in every kernel."""
    before = _choice.set(choice)
    try:
        yield
    finally:
        _choice.reset(before)


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
    return tuple(backend for backend in written if why_missing(kernel, backend) is None)


def why_missing(kernel: str, backend: str) -> str | None:
    """Why a backend of a kernel cannot run here, in a line; None if it can."""
    if backend not in _written_backends(kernel):
        return "it is not written"
    if backend == "cuda":
        return why_no_gsplat()
    return why_no_triton() if backend == "triton" else None


def implementation(
    kernel: str,
    function: str,
    backend: Backend,
    device: torch.device,
    *,
    dtype: torch.dtype = torch.float32,
) -> Callable[..., Any]:
    """The function of a kernel's backend, for numbers of a kind on a device.

    `auto` takes numba on the CPU and Triton on a GPU, otherwise the plain reference, which alone
    takes other numbers than float32. Where `kernels_chosen` asks for `torch`, it takes the
    reference for all but the rasteriser; where it asks for `gsplat`, that draws and everything else
    stays as it is.

    Raises:
        BackendError: the backend does not exist for this kernel, cannot run here or does not take
            such numbers, or a GPU has no rasteriser.
    """
    if dtype != torch.float32:
        if backend in ("cpu", "triton"):
            raise BackendError(f"the {backend} {kernel} takes float32, got {dtype}")
        backend = "reference" if backend == "auto" else backend
    found = available_backends(kernel)
    chosen: str = _automatic(kernel, device, found) if backend == "auto" else backend
    if chosen not in found:
        raise BackendError(
            f"kernel {kernel!r} has no {chosen!r} backend here: {why_missing(kernel, chosen)} "
            f"(available: {', '.join(found)})"
        )
    if chosen == "cpu" and device.type != "cpu":
        raise BackendError(f"the numba {kernel} runs on the CPU, got a tensor on {device}")
    if chosen == "triton" and device.type != "cuda" and not is_interpreting():
        raise BackendError(f"the triton backend needs tensors on a CUDA device, got {device}")
    return getattr(import_module(f"lidarpainter_models.kernels.{kernel}.{chosen}"), function)


def _automatic(kernel: str, device: torch.device, found: tuple[str, ...]) -> str:
    """The backend that `auto` stands for, given what can run here."""
    choice = _choice.get()
    if kernel == RASTERISER and choice == "gsplat":
        reason = why_missing(kernel, "cuda")
        if reason is not None:
            raise BackendError(f"kernels=gsplat: gsplat cannot draw here: {reason}")
        return "cuda"
    if kernel == RASTERISER and device.type == "cuda" and "triton" not in found:
        raise BackendError(
            f"drawing on {device} needs Triton ({why_missing(kernel, 'triton')}), or gsplat with "
            "--set kernels=gsplat"
        )
    if kernel != RASTERISER and choice == "torch":
        return "reference"
    return next((name for name in FASTEST.get(device.type, ()) if name in found), "reference")


def check_choice(choice: KernelChoice) -> None:
    """Refuse kernels that cannot run here before anything else is done.

    Raises:
        ConfigError: gsplat was asked for and cannot draw here.
    """
    if choice == "gsplat" and (reason := why_no_gsplat()):
        raise ConfigError(f"kernels=gsplat: {reason}; expected auto (our own kernels) or torch")


def may_run_on_host(device: torch.device) -> bool:
    """Whether numbers of a device may be given to code of the CPU that is no kernel (OpenCV)."""
    return device.type == "cpu" and _choice.get() != "torch"
