"""Settings of the whole process that must stand before heavy packages are imported.

What the user has set stays as it is.
"""

import ctypes
import os
import sys
import tempfile
import warnings
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path
from urllib.parse import urlsplit

from catalog.folders import cache_folder, expanded, home_folder
from tasks.job_limits import usable_cores

PREFECT = {
    "PREFECT_SERVER_EPHEMERAL_STARTUP_TIMEOUT_SECONDS": "120",
    "PREFECT_SERVER_ANALYTICS_ENABLED": "false",
    "PREFECT_CLOUD_ENABLE_ORCHESTRATION_TELEMETRY": "false",
    "DO_NOT_TRACK": "1",
}
THREADS = {
    # spinning OpenMP threads turn shared cores into many times the CPU time
    "OMP_WAIT_POLICY": "passive",
    # numba looks for TBB first and warns where the one it finds is too old
    "NUMBA_THREADING_LAYER_PRIORITY": "omp workqueue tbb",
}
KEPT_BYTES = 32 << 20
"""Largest freed block that the C library keeps for the next use: as far as glibc goes by itself."""
LOOPBACK = ("127.0.0.1", "localhost", "::1")
"""This machine: servers of our own listen there, and a proxy would look for them on its own one."""
PROXIES = ("http_proxy", "https_proxy", "all_proxy")
PREFECT_HOME = "PREFECT_HOME"
M_TRIM_THRESHOLD, M_MMAP_THRESHOLD, M_ARENA_MAX = -1, -3, -8  # of malloc.h

_chosen_homes: set[str] = set()
"""Folders for Prefect that were chosen here, not by the user."""


def prepare_environment(*, log_level: str | None = "CRITICAL") -> None:
    """Set what Prefect, OpenMP and numba read at import, and keep freed memory.

    Without a `log_level` Prefect decides which of its log lines are shown.
    """
    threads = str(usable_cores())
    counts = {"NUMBA_NUM_THREADS": threads, "OMP_NUM_THREADS": threads}
    level = {} if log_level is None else {"PREFECT_LOGGING_LEVEL": log_level}
    for name, value in {**PREFECT, **THREADS, **counts, **level}.items():
        os.environ.setdefault(name, value)
    _reach_own_servers()
    _keep_freed_memory()
    if not _has_cache_folder():
        # a fresh private folder: compiled code is unpickled, nobody else may put it there
        os.environ.setdefault("NUMBA_CACHE_DIR", tempfile.mkdtemp(prefix="lidarpainter-numba-"))


def keep_prefect_in(store: str) -> None:
    """Let Prefect keep its database in a store where it cannot keep it in the home folder.

    Making a database takes longer than starting a server, so one in the home folder serves all
    stores. Where there is no home folder, or it cannot be written, the database lies in the store,
    or for a bucket in the cache in front of it. A folder that the user has chosen by `PREFECT_HOME`
    stays, and so do profiles. Nothing is made before a server is started.
    """
    if os.environ.get(PREFECT_HOME, "") not in {"", *_chosen_homes}:
        return
    home = home_folder()
    if home is not None and os.path.isdir(home) and _can_write(home):  # noqa: PTH112 raises nothing
        os.environ.pop(PREFECT_HOME, None)
        return
    place = cache_folder() if store.startswith("s3:/") else expanded(store)
    os.environ[PREFECT_HOME] = str(place / "prefect")
    _chosen_homes.add(os.environ[PREFECT_HOME])
    profiles = (home or place) / ".prefect" / "profiles.toml"
    with suppress(OSError):  # the home folder is another user's
        if profiles.is_file():
            os.environ.setdefault("PREFECT_PROFILES_PATH", str(profiles))
    # Prefect would make the folder when it is imported, be there a store or not
    warnings.filterwarnings("ignore", message="Failed to create the Prefect home directory")


def _reach_own_servers() -> None:
    """Have clients reach servers on this machine past any proxy that the environment names.

    A proxy whose address is none, or of a kind that Prefect's client (httpx) cannot speak to, is
    left out and named: the client ends with it, whomever it is to reach.
    """
    for name in [name for name in os.environ if name.lower() in PROXIES]:
        if why := _why_unusable(os.environ[name]):
            said = f"{name} is left out: {os.environ.pop(name)!r} {why}"
            sys.stderr.write(f"lidarpainter: {said}\n")
    known = (os.environ.get("no_proxy") or os.environ.get("NO_PROXY") or "").split(",")
    hosts = dict.fromkeys(filter(None, (*map(str.strip, known), *LOOPBACK)))
    os.environ["no_proxy"] = os.environ["NO_PROXY"] = ",".join(hosts)


def _why_unusable(proxy: str) -> str | None:
    """What is wrong with the address of a proxy; None of a good one, and of an empty text."""
    if not proxy:
        return None
    try:
        parts = urlsplit(proxy if "://" in proxy else f"http://{proxy}")
        is_address = bool(parts.hostname) and parts.port != 0
    except ValueError:
        is_address = False
    if not is_address:
        return "is no address of a proxy (http://HOST:PORT)"
    if parts.scheme.startswith("socks5"):
        has_socks = find_spec("socksio") is not None
        return None if has_socks else "needs the package socksio: pip install socksio"
    if parts.scheme not in ("http", "https"):
        return "is of a kind that is not spoken here, expected http://HOST:PORT"
    return None


def _keep_freed_memory() -> None:
    """Let glibc keep blocks up to `KEPT_BYTES` from the start, for all threads in one place.

    It comes to that by itself once such a block was freed (mallopt(3), M_MMAP_THRESHOLD); until
    then every image pays for fresh pages, ten thousand page faults a painted view. What each thread
    keeps for itself no other one can use: a run came to twice its memory. Other C libraries have no
    such settings.
    """
    adjust = getattr(ctypes.CDLL(None), "mallopt", None) if os.name == "posix" else None
    if adjust is not None and not any(name.startswith("MALLOC_") for name in os.environ):
        adjust(M_MMAP_THRESHOLD, KEPT_BYTES)
        adjust(M_TRIM_THRESHOLD, 2 * KEPT_BYTES)
        adjust(M_ARENA_MAX, 1)


def _has_cache_folder() -> bool:
    """Whether numba can keep compiled code beside the sources or in the user's cache."""
    package = Path(__file__).resolve().parents[1] / "lidarpainter_models" / "kernels"
    home, chosen = home_folder(), os.environ.get("XDG_CACHE_HOME")
    user = Path(chosen) if chosen else home and home / ".cache"
    return _can_write(package / "__pycache__") or (user is not None and _can_write(user / "numba"))


def _can_write(folder: Path) -> bool:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return True
    except OSError:
        return False
