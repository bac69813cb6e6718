"""What a page says of the machine it was made on, and when."""

import os
import platform
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING

import lidarpainter_models
from tasks.job_limits import usable_cores, usable_memory_bytes

if TYPE_CHECKING:
    import torch

PACKAGES = ("torch", "numba", "numpy")
_CPU_FACTS = Path("/proc/cpuinfo")


def machine(device: "torch.device") -> dict[str, str]:
    """Names and values: date, processor, cores, memory, device, versions."""
    import torch

    is_gpu = device.type == "cuda"
    return {
        "date": datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC"),
        "processor": _processor(),
        "cores": f"{usable_cores()} to be used of {os.cpu_count()}",
        "memory": f"{usable_memory_bytes() / 1e9:.1f} GB",
        "device": f"{device.type}, {torch.cuda.get_device_name(device)}" if is_gpu else device.type,
        "system": platform.platform(),
        "versions": ", ".join(
            [
                f"lidarpainter {lidarpainter_models.__version__}",
                f"python {platform.python_version()}",
                *(f"{name} {_version(name)}" for name in PACKAGES),
            ]
        ),
    }


def _processor() -> str:
    """The model, which only the system's own table names on Linux."""
    try:
        lines = _CPU_FACTS.read_text("utf-8", "replace").splitlines()
    except OSError:
        lines = []
    models = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return next(iter(models), "") or platform.processor() or platform.machine()


def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return "not installed"
