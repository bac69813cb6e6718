"""End a command within two seconds of Ctrl-C or SIGTERM, whatever it is busy with.

The first signal raises `Interrupted` in the main thread, and the work cleans up on its way out: it
is no `Exception`, so nobody takes it for a failure. Where that takes longer than `GRACE_S`, in a
kernel or in a client that waits for its server, a thread enters what must be entered and ends the
process, after `LATE_S` also where the store does not answer. Further signals change nothing: the
end is that near. Flows that a worker runs are interrupted by Prefect's own exceptions, and enter
the same on their way out.
"""

import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import FrameType
from typing import NoReturn

SIGNALS = (signal.SIGINT, signal.SIGTERM)
GRACE_S = 0.7
"""How long the work may take to clean up."""
LATE_S = 5.0
"""How long entering may take then; a bucket that is away is asked for a minute."""
MESSAGE = "interrupted; the same command goes on where this one stopped"
CLEAN_LINE = "\r\x1b[K\x1b[?25h"
"""Clears the line of a terminal and brings back its cursor, which progress bars hide."""
STDERR = 2

_ending = threading.Lock()
_caught: list[int] = []
"""The signal that came first."""
_started: list[int] = []
"""Descriptors of the processes that were there then: those that theirs leave behind end too."""
_message = [MESSAGE]
"""What a command says that is interrupted."""
_actions: list[Callable[[], object]] = []
"""What `at_interruption` blocks enter, outermost first."""


class Interrupted(BaseException):
    """A signal asks the command to end."""


def watch() -> None:
    """Answer signals from here on; one that is ignored, as after `nohup`, stays so."""
    told, tell = os.pipe()
    os.set_blocking(tell, False)
    signal.set_wakeup_fd(tell, warn_on_full_buffer=False)
    for number in SIGNALS:
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, _interrupt)
    threading.Thread(target=_end_in_time, args=(told,), daemon=True).start()


def leave(code: int) -> NoReturn:
    """End the process with an exit code, or after a signal with that of the signal.

    The interpreter is not taken down: threads of the libraries, arrow's above all, may abort a
    process that is on its way out, whose work is done and on the disk.
    """
    if _caught:
        _end(is_late=False)
    for stream in (sys.stdout, sys.stderr):
        with suppress(Exception):
            stream.flush()
    os._exit(code)


def goes_on() -> None:
    """Let an interrupted command say that the same one goes on, as all do but for these below."""
    _message[:] = [MESSAGE]


def starts_anew(what: str) -> None:
    """Let an interrupted command say that the same one does not go on, but begins something."""
    _message[:] = [f"interrupted; the same command begins {what} anew"]


def ends_as_meant() -> None:
    """Let an interrupted command say that it is closed: nothing was left half done."""
    _message[:] = ["closed"]


def message() -> str:
    """What the command says when it is interrupted."""
    return _message[0]


def is_interrupted() -> bool:
    """Whether a signal has come: what fails from then on fails because of it."""
    return bool(_caught)


@contextmanager
def at_interruption(action: Callable[[], object]) -> Iterator[None]:
    """Do something if the block is interrupted: at its end, or late where it does not end."""
    _actions.append(action)
    try:
        yield
    except BaseException as error:
        if not isinstance(error, Exception):
            _try(action)
        raise
    finally:
        _actions.remove(action)


def _interrupt(number: int, _frame: FrameType | None) -> None:
    if not _caught:
        _remember(number)
        raise Interrupted


def _remember(number: int) -> None:
    _caught.append(number)
    # what breaks on the way out is no news
    sys.unraisablehook = lambda _what: None
    threading.excepthook = lambda _what: None


def _end_in_time(told: int) -> None:
    """Wait for a signal, which Python tells even while the main thread is in a kernel."""
    number = 0
    while number not in SIGNALS:
        number = os.read(told, 1)[0]
    _started.extend(_descendants())
    time.sleep(GRACE_S)
    if not _caught:  # the handler could not run, or is Prefect's
        _remember(number)
    _end(is_late=True)


def _end(*, is_late: bool) -> NoReturn:
    _ending.acquire()  # never released: one thread ends the process
    with suppress(Exception):
        sys.stdout.flush()
    with Path(os.devnull).open("w") as nowhere:
        sys.stdout = sys.stderr = nowhere  # what is drawn while the work ends is not seen
        _end_now(is_late=is_late)


def _end_now(*, is_late: bool) -> NoReturn:
    if is_late:
        entering = threading.Thread(target=_enter, daemon=True)
        entering.start()
        entering.join(LATE_S)
    for process in {*_started, *_descendants()}:
        with suppress(OSError):
            signal.pidfd_send_signal(process, signal.SIGKILL)
    with suppress(OSError):
        line = f"{CLEAN_LINE if os.isatty(STDERR) else ''}lidarpainter: {message()}\n"
        os.write(STDERR, line.encode())
    os._exit(128 + _caught[0])


def _enter() -> None:
    for action in reversed(_actions):
        _try(action)


def _try(action: Callable[[], object]) -> None:
    with suppress(Exception):  # the disk may be full; a run whose lock is free counts as ended
        action()


def _descendants() -> list[int]:
    """Descriptors of the processes this one has started and theirs, where the kernel lists them."""
    found, descriptors = [os.getpid()], []
    for parent in found:
        for children in Path(f"/proc/{parent}/task").glob("*/children"):
            with suppress(OSError):
                found += map(int, children.read_text("ascii").split())
    for process_id in found[1:]:
        with suppress(OSError):  # it has ended meanwhile
            descriptors.append(os.pidfd_open(process_id))
    return descriptors
