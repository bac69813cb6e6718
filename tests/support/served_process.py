"""`lidarpainter serve` in a process of its own."""

import os
import subprocess
import sys
from contextlib import contextmanager


@contextmanager
def serving(run, *words):
    """The process of a server of a run, and the lines that it says first: its addresses."""
    command = ["--store", str(run.store.root), "serve", run.run_id, "--port", "0", *map(str, words)]
    process = subprocess.Popen(
        [sys.executable, "-m", "flows.cli", *command],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
    )
    assert process.stdout is not None
    with process:
        try:
            yield (
                process,
                [process.stdout.readline().strip() for _ in range(1 + ("--http-port" in words))],
            )
        finally:
            process.kill()
