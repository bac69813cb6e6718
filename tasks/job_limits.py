"""Memory and cores that this process may use: the machine's, or less where its job has a limit.

SLURM, systemd, Docker and Kubernetes set limits by control groups of version 1, of version 2, or of
both. A process is held by the limit of its own group and by that of every group above it, so the
smallest of them counts. Inside a container `/proc/self/cgroup` may still name the path on the host,
of which the mounted tree shows only the end; what lies there is read then.
"""

import math
import os
from collections.abc import Iterator
from pathlib import Path

CGROUPS = Path("/sys/fs/cgroup")
"""Where control groups are mounted."""
MEMBERSHIP = Path("/proc/self/cgroup")
"""A line for each hierarchy: its number, controllers (none in version 2), the path of the group."""
V1_FOLDERS = {"memory": ("memory",), "cpu": ("cpu", "cpu,cpuacct", "cpuacct,cpu")}
"""Where version 1 is mounted, by controller."""


def usable_memory_bytes(cgroups: Path = CGROUPS, membership: Path = MEMBERSHIP) -> float:
    """Return the bytes of memory that this process and its job may take together."""
    limits = [float(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))]
    for folder in _groups("memory", cgroups, membership):
        for name in ("memory.max", "memory.limit_in_bytes"):
            limits += [number for number in _numbers(folder / name)[:1] if number > 0]
    return min(limits)


def usable_cores(cgroups: Path = CGROUPS, membership: Path = MEMBERSHIP) -> int:
    """Return the number of cores that this process may keep busy; a quota is rounded up."""
    has_affinity = hasattr(os, "sched_getaffinity")  # it knows cpusets too
    cores = [len(os.sched_getaffinity(0)) if has_affinity else os.cpu_count() or 1]
    for folder in _groups("cpu", cgroups, membership):
        quotas = (
            _numbers(folder / "cpu.max"),
            _numbers(folder / "cpu.cfs_quota_us") + _numbers(folder / "cpu.cfs_period_us"),
        )
        cores += [math.ceil(q[0] / q[1]) for q in quotas if len(q) == 2 and min(q) > 0]
    return max(min(cores), 1)


def _groups(controller: str, cgroups: Path, membership: Path) -> Iterator[Path]:
    """Yield the folders of this process's group and of all groups above it, in both versions."""
    v1_path, v2_path = "/", "/"
    for line in _text(membership).splitlines():
        number, _, rest = line.partition(":")
        controllers, _, path = rest.partition(":")
        if controller in controllers.split(","):
            v1_path = path
        elif number == "0" and not controllers:
            v2_path = path
    mounts = [(cgroups / name, v1_path) for name in V1_FOLDERS[controller]]
    for mount, path in [*mounts, (cgroups, v2_path), (cgroups / "unified", v2_path)]:
        parts = [part for part in path.split("/") if part not in ("", ".", "..")]
        # the longest end of the path that is mounted: the rest lies outside the container
        ends = (mount.joinpath(*parts[first:]) for first in range(len(parts) + 1))
        folder = next((end for end in ends if end.is_dir()), mount)
        yield folder
        while folder != mount:
            folder = folder.parent
            yield folder


def _numbers(path: Path) -> list[float]:
    """Return the whole numbers of a file; none where it is absent or says `max`."""
    words = _text(path).split()
    return [float(word) for word in words] if all(word.isdecimal() for word in words) else []


def _text(path: Path) -> str:
    try:
        return path.read_text("ascii", "replace")
    except OSError:
        return ""
