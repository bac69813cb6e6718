"""Train the one-step painter in several processes: torchrun starts them, this module is what runs.

    torchrun --nproc-per-node N -m lidarpainter_models.painter.one_step.processes JOB

JOB is a file that `run_in_processes` writes. The first process says on standard output how far the
training is, a JSON object a line, and keeps the checkpoints; its last one is the result. All end
with whoever has started them: the pipe on their standard input closes then.
"""

import json
import os
import pickle
import subprocess
import sys
import threading
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
import torch.distributed

from lidarpainter_models import errors
from lidarpainter_models.errors import ConfigError, LidarPainterError, TrainingError
from lidarpainter_models.painter.examples import PairSource
from lidarpainter_models.painter.training.loop import Told, TrainingProgress
from lidarpainter_models.painter.training.processes import Processes

if TYPE_CHECKING:
    from lidarpainter_models.painter.one_step.job import OneStepJob

JOB_FILE = "job.pickle"
LOG_FILE = "processes.log"
"""What the processes complain of; it stays beside the checkpoints of a training that broke off."""
GRACE_S = 60.0
"""How long the processes may take to end once the pipe is closed."""
INTERRUPTED_GRACE_S = 0.5
"""The same where somebody waits for the end."""


def run_in_processes(
    training: "OneStepJob",
    sources: Sequence[PairSource],
    folder: Path,
    num_processes: int,
    told: Told,
) -> None:
    """Train in so many processes to the end; the last checkpoint lies in the folder.

    Raises:
        ConfigError: fewer GPUs than processes, on a machine that has some.
        TrainingError: the loss is no longer finite, or a process has ended early.
    """
    if 0 < torch.cuda.device_count() < num_processes:
        raise ConfigError(
            f"{num_processes} processes need as many GPUs, this machine has "
            f"{torch.cuda.device_count()}"
        )
    folder.mkdir(parents=True, exist_ok=True)
    job = folder / JOB_FILE
    job.write_bytes(pickle.dumps((training, tuple(sources), folder)))
    torchrun = ["-m", "torch.distributed.run", "--standalone", "--local-addr", "127.0.0.1"]
    command = [*torchrun, "--nproc-per-node", str(num_processes), "-m", main.__module__, str(job)]
    with (folder / LOG_FILE).open("wb") as log:
        running = subprocess.Popen(  # noqa: S603 - this very Python
            [sys.executable, *command],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=log,
            start_new_session=True,  # Ctrl-C is for whoever has started them
        )
        grace_s = GRACE_S
        try:
            refusal = _followed(running, told)
        except BaseException as error:
            grace_s = GRACE_S if isinstance(error, Exception) else INTERRUPTED_GRACE_S
            raise
        finally:
            _end(running, grace_s)
    if refusal is not None:
        raise refusal
    if running.returncode:
        raise TrainingError(
            "a training in several processes broke off, its last checkpoint is kept: one of them "
            f"has ended, see {folder / LOG_FILE}"
        )
    job.unlink()


def _followed(running: "subprocess.Popen[bytes]", told: Told) -> LidarPainterError | None:
    """Pass on how far the training is, until its end; returns what it has refused."""
    refusal = None
    assert running.stdout is not None  # noqa: S101
    for line in running.stdout:
        if not line.startswith(b"{"):
            continue  # what other packages print
        said: dict[str, Any] = json.loads(line)
        if "error" in said:
            refusal = refusal or getattr(errors, said["error"])(said["message"])
        else:
            told(TrainingProgress(**said))
    return refusal


def _end(running: "subprocess.Popen[bytes]", grace_s: float) -> None:
    """Close the pipe that they end with, and wait until they have ended."""
    assert running.stdin is not None and running.stdout is not None  # noqa: S101, PT018
    running.stdin.close()
    try:
        running.wait(grace_s)
    except subprocess.TimeoutExpired:
        running.kill()
        running.wait()
    running.stdout.close()


def main(job: Path) -> None:
    """Train as the process that torchrun's environment says this is."""
    threading.Thread(target=_end_with_starter, daemon=True).start()
    training, sources, folder = pickle.loads(job.read_bytes())  # noqa: S301 - we have written it
    has_gpu = torch.cuda.is_available()
    device = torch.device("cpu")
    if has_gpu:
        device = torch.device("cuda", torch.distributed.get_node_local_rank())
        torch.cuda.set_device(device)
    torch.distributed.init_process_group("nccl" if has_gpu else "gloo")
    processes = Processes(device=device)
    told = _say_progress if processes.index == 0 else None
    try:
        training.train_as_one(sources, folder, device=device, processes=processes, told=told)
    except LidarPainterError as error:
        _say({"error": type(error).__name__, "message": str(error)})
        raise SystemExit(1) from None
    finally:
        torch.distributed.destroy_process_group()


def _say_progress(progress: TrainingProgress) -> None:
    _say(asdict(progress))


def _say(message: dict[str, Any]) -> None:
    sys.stdout.write(json.dumps(message) + "\n")  # one write: lines of processes do not mix
    sys.stdout.flush()


def _end_with_starter() -> None:
    sys.stdin.read()
    os._exit(1)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
