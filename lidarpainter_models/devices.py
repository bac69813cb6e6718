"""Which device does the work, how, and with what memory; names alone are read without torch."""

import ctypes
import os
import re
from collections.abc import Callable, Collection
from dataclasses import fields, replace
from typing import TYPE_CHECKING, Any, Literal, TypeVar

from lidarpainter_models.errors import ConfigError, DeviceMemoryError

if TYPE_CHECKING:
    import torch

Device = str
"""`auto`, `cpu`, `cuda` or `cuda:N`; see `check_device`."""
KernelChoice = Literal["auto", "torch", "gsplat"]
"""Which kernels run. `auto` takes this project's own fast kernels, `torch` plain torch for all but
the rasteriser (a GPU's way, tried on a CPU), and `gsplat` lets gsplat draw on an NVIDIA GPU."""
Made = TypeVar("Made")
_DEVICES = re.compile(r"auto|cpu|cuda(:\d+)?")


def check_device(name: Device) -> Device:
    """The name of a device, if it can be one.

    Raises:
        ConfigError: it cannot.
    """
    if not _DEVICES.fullmatch(name):
        raise ConfigError(f"no device {name!r}, expected auto, cpu, cuda or cuda:N")
    return name


def chosen_device(name: Device) -> "torch.device":
    """The device by name; `auto` takes the GPU if there is one, and `cuda` the current one.

    Raises:
        ConfigError: no such device, or none that works here.
    """
    check_device(name)
    import torch  # whoever only names a device does without

    has_gpu = torch.cuda.is_available()
    if name.startswith("cuda") and not has_gpu:
        raise ConfigError(f"device {name}: no CUDA device works here, expected cpu or auto")
    if name == "cpu" or not has_gpu:
        return torch.device("cpu")
    device = torch.device("cuda" if name == "auto" else name)
    count = torch.cuda.device_count()
    if device.index is None:  # a tensor's device has one, and is compared with this
        return torch.device("cuda", torch.cuda.current_device())
    if device.index >= count:
        raise ConfigError(f"device {name}: expected cuda:0 to cuda:{count - 1}, which are here")
    return device


def within_memory(work: Callable[[bool], Made], device: "torch.device", what: str) -> Made:
    """Do some work; where its device's memory runs out, once more and sparingly.

    `work` is told whether to spare memory; `what` names it in the error, with what takes less.

    Raises:
        DeviceMemoryError: even the second try did not fit.
    """
    import torch

    try:
        return work(False)
    except torch.OutOfMemoryError:
        pass  # what the work held is free only once its error is gone
    if device.type == "cuda":
        torch.cuda.empty_cache()
    try:
        return work(True)
    except torch.OutOfMemoryError as error:
        raise DeviceMemoryError(f"{device} has too little memory for {what}") from error


def return_freed_memory() -> None:
    """Return to the system what the C library keeps of freed memory, where it is glibc.

    It keeps what lies below anything still in use (malloc_trim(3)): after much work with arrays of
    a few megabytes, a third of the process.
    """
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None) if os.name == "posix" else None
    if trim is not None:
        trim(0)


def on_device(value: Made, device: "torch.device", *, stays: Collection[str] = ()) -> Made:
    """A dataclass with its tensors on another device, but for the fields that are to stay."""
    import torch

    found: Any = value
    columns = {part.name: getattr(found, part.name) for part in fields(found)}
    is_late = device.type != "cpu"  # what is copied to the host must be whole when it is read
    sent = {
        name: column.to(device, non_blocking=is_late)
        for name, column in columns.items()
        if isinstance(column, torch.Tensor) and name not in stays
    }
    return replace(found, **sent)
