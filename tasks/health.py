"""Whether this machine can do the work: packages, system libraries, devices, disk.

`tasks.ingest.data_checks` looks at scenes and datasets.
"""

import os
import platform
import shutil
import sys
from dataclasses import dataclass
from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Literal

from catalog.folders import nearest_existing
from tasks.job_limits import usable_memory_bytes

Verdict = Literal["ok", "warn", "fail"]
PYTHON_RANGE = ((3, 11), (3, 14))
REQUIRED = ("torch", "numpy", "scipy", "numba", "pyarrow", "zarr", "deltalake", "prefect", "typer")
MIN_FREE_BYTES = 5_000_000_000
"""A reconstruction of a full sequence keeps a few GB of artefacts."""
MIN_MEMORY_BYTES = 6_000_000_000
_DRIVER = Path("/proc/driver/nvidia/version")


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing that was checked."""

    name: str
    verdict: Verdict
    detail: str


def check_environment(store_path: Path) -> list[Finding]:
    """Check everything a reconstruction needs here."""
    packages = [_python(), *map(_package, REQUIRED), _open3d(), _numba()]
    return [*packages, *gpu_findings(), _memory(), _disk(store_path), _painter()]


def _python() -> Finding:
    low, high = PYTHON_RANGE
    is_fit = low <= sys.version_info[:2] < high
    detail = f"{platform.python_version()}, expected >={low[0]}.{low[1]},<{high[0]}.{high[1]}"
    return Finding("python", "ok" if is_fit else "fail", detail)


def _package(name: str) -> Finding:
    try:
        return Finding(name, "ok", version(name))
    except PackageNotFoundError:
        return Finding(name, "fail", f"not installed: pip install {name}")


def _open3d() -> Finding:
    try:
        module = import_module("open3d")
    except (ImportError, OSError) as error:
        advice = "apt-get install libegl1 libgl1 libx11-6 libusb-1.0-0"
        return Finding("open3d", "warn", f"{error}; try: {advice}")
    return Finding("open3d", "ok", module.__version__)


def _numba() -> Finding:
    """Whether kernels compile, which a broken LLVM or an unwritable cache prevents."""
    try:
        numba = import_module("numba")
        answer = numba.njit(lambda number: number + 1)(1)
    except Exception as error:  # noqa: BLE001 - whatever it is, the kernels will not run
        return Finding("kernels", "fail", f"numba cannot compile: {error}")
    is_right = answer == 2
    detail = f"compile; {numba.get_num_threads()} threads of {os.cpu_count()} cores"
    return Finding("kernels", "ok" if is_right else "fail", detail)


def gpu_findings() -> list[Finding]:
    """What there is of a GPU, and what is missing to use it: driver, torch, rasterisers.

    A machine without a GPU is fit; one whose GPU cannot be used is warned.
    """
    torch = import_module("torch")
    driver = _driver()
    works = torch.cuda.is_available()
    findings = [Finding("gpu driver", "ok", driver or "none: the CPU does the work")]
    if torch.version.cuda is None:
        advice = "; its GPU needs torch's build for CUDA: https://pytorch.org/get-started"
        detail = f"torch {torch.__version__} is built for the CPU{advice if driver else ''}"
        findings.append(Finding("torch build", "warn" if driver else "ok", detail))
    else:
        findings.append(Finding("torch build", "ok", f"for CUDA {torch.version.cuda}"))
    if not works:
        is_odd = driver is not None and torch.version.cuda is not None
        detail = "cpu (no CUDA device" + (": torch cannot use the driver's)" if is_odd else ")")
        findings.append(Finding("device", "warn" if is_odd else "ok", detail))
        return findings
    findings.append(Finding("device", "ok", torch.cuda.get_device_name()))
    return [*findings, _rasteriser()]


def _driver() -> str | None:
    """The NVIDIA driver as the kernel or its own program names it."""
    try:
        return _DRIVER.read_text("utf-8", "replace").splitlines()[0].strip()
    except (OSError, IndexError):
        found = shutil.which("nvidia-smi")
        return f"{found} is here" if found else None


def _rasteriser() -> Finding:
    """Which rasteriser a GPU gets, and why not the ones before it."""
    from lidarpainter_models.kernels.backends import FASTEST, why_missing

    reasons: list[str] = []
    for backend in FASTEST["cuda"]:
        reason = why_missing("gaussian_raster", backend)
        if reason is None:
            return Finding("rasteriser", "ok", "; ".join([f"{backend} on the GPU", *reasons]))
        reasons.append(f"not {backend}: {reason}")
    return Finding("rasteriser", "warn", "; ".join([*reasons, "plain torch is far too slow"]))


def _memory() -> Finding:
    total = usable_memory_bytes()
    verdict: Verdict = "ok" if total >= MIN_MEMORY_BYTES else "warn"
    return Finding("memory", verdict, f"{total / 1e9:.1f} GB")


def _disk(store_path: Path) -> Finding:
    existing = nearest_existing(store_path)
    if not os.access(existing, os.W_OK):
        return Finding("store", "fail", f"{existing} cannot be written")
    free = shutil.disk_usage(existing).free
    verdict: Verdict = "ok" if free >= MIN_FREE_BYTES else "warn"
    return Finding("store", verdict, f"{store_path}, {free / 1e9:.1f} GB free")


def _painter() -> Finding:
    from lidarpainter_models.errors import WeightsError
    from lidarpainter_models.painter.known_painters import BUNDLED_NANO
    from lidarpainter_models.painter.selection import load_painter

    try:
        load_painter("nano")
    except WeightsError as error:
        return Finding("painter nano", "fail", str(error))
    return Finding("painter nano", "ok", f"{BUNDLED_NANO.stat().st_size / 1e6:.1f} MB of weights")
