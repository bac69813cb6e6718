"""Environment variables that must stand before heavy packages are imported.

What the user has set stays as it is.
"""

import os

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
QUIET = {"PREFECT_LOGGING_LEVEL": "CRITICAL"}
"""Errors reach the user as one line of ours, not as Prefect's traceback."""


def prepare_environment(*, is_quiet: bool) -> None:
    """Set what Prefect, OpenMP and numba read at import."""
    for name, value in {**PREFECT, **THREADS, **(QUIET if is_quiet else {})}.items():
        os.environ.setdefault(name, value)
