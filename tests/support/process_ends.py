"""Which processes have not ended."""

import psutil


def still_running(processes):
    """Those that have not ended a second later.

    A zombie has: in a container there may be nobody who asks for the exit status of an orphan.
    """
    _, alive = psutil.wait_procs(processes, timeout=1)
    return [process for process in alive if not _is_zombie(process)]


def _is_zombie(process):
    try:
        return process.status() == psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return True
