"""Processes that a command starts for itself, and that end with it however it ends."""

import os
import subprocess
import sys
from collections.abc import Mapping, Sequence

# prctl(PR_SET_PDEATHSIG): the kernel ends the child when its parent dies, even of SIGKILL
LAUNCHER = """
import ctypes, os, signal, sys
parent = int(sys.argv[1])
if sys.platform == "linux":
    ctypes.CDLL(None).prctl(1, signal.SIGTERM)
    if os.getppid() != parent:
        sys.exit(1)
os.execv(sys.executable, [sys.executable, *sys.argv[2:]])
"""


def start_child(
    arguments: Sequence[str], *, log: int, environment: Mapping[str, str]
) -> subprocess.Popen[bytes]:
    """Start the interpreter with some arguments, for as long as this process lives.

    `log` is the descriptor of a file for what it has to say; `environment` is all of its own.
    """
    return subprocess.Popen(  # noqa: S603 - our own interpreter and arguments
        [sys.executable, "-c", LAUNCHER, str(os.getpid()), *arguments],
        stdin=subprocess.DEVNULL,
        stdout=log,
        stderr=log,
        env=dict(environment),
        start_new_session=True,  # Ctrl-C is for the command, which ends its children itself
    )
