"""What kernels for an NVIDIA GPU need: the packages, why one is missing, tensors without gaps."""

import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, redirect_stdout
from functools import cache
from importlib import import_module
from types import ModuleType

import torch
from torch import Tensor

from lidarpainter_models.errors import BackendError


@cache
def why_no_gsplat() -> str | None:
    """Why gsplat cannot draw here, in a line; None if it can."""
    if not torch.cuda.is_available():
        return "no CUDA device"
    try:
        import_gsplat()
    except BackendError as error:
        return str(error)
    return None


@cache
def why_no_triton() -> str | None:
    """Why Triton's kernels cannot run here, in a line; None if they can.

    Without a GPU they can in Triton's interpreter, which `TRITON_INTERPRET=1` in the environment
    turns on. Triton builds its launcher once, with a C compiler and Python's headers.
    """
    try:
        triton = import_module("triton")
    except ImportError as error:
        return f"Triton is not installed ({error}); torch's builds for CUDA bring it along"
    if is_interpreting():
        return None
    if not torch.cuda.is_available():
        return "no CUDA device"
    try:
        triton.runtime.driver.active.get_current_target()
    except (ImportError, OSError, RuntimeError, subprocess.CalledProcessError) as error:
        return f"Triton could not build its launcher (gcc, Python headers): {_first_line(error)}"
    return None


def is_interpreting() -> bool:
    """Whether Triton's kernels run in its interpreter, on tensors of the CPU."""
    return bool(import_module("triton").knobs.runtime.interpret)


def import_gsplat() -> ModuleType:
    """Gsplat with kernels that can run; it compiles them here if no wheel brought them.

    Raises:
        BackendError: it is not installed, or there are no kernels and no compiler for them.
    """
    try:
        gsplat = import_module("gsplat")
    except ImportError as error:
        raise BackendError(
            f"the cuda backend needs gsplat ({error}); install the extra: "
            "pip install 'lidarpainter[cuda]'"
        ) from error
    try:
        with redirect_stdout(sys.stderr):  # what it says of compiling is no answer of ours
            kernels = import_module("gsplat.cuda._backend")._C
    except (ImportError, OSError, RuntimeError) as error:
        raise BackendError(
            f"gsplat could not load or compile its kernels: {_first_line(error)}"
        ) from error
    if kernels is None:
        raise BackendError(
            f"gsplat has no compiled kernels and finds no nvcc; install its wheel for torch "
            f"{torch.__version__} or a CUDA toolkit (CUDA_HOME)"
        )
    return gsplat


@contextmanager
def dense_in_place(tensors: Sequence[Tensor]) -> Iterator[list[Tensor]]:
    """The tensors for a kernel that changes them; what had to be copied is copied back."""
    dense = [tensor.contiguous() for tensor in tensors]
    yield dense
    for tensor, changed in zip(tensors, dense, strict=True):
        if tensor is not changed:
            tensor.copy_(changed)


def _first_line(error: Exception) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0]
